"""The synthetic user reaches targets, the same way each time, straight and through the emulated wire."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner

import benches
from firmware_py.endoscope.control import ControlConfig
from firmware_py.endoscope.report import report_csv
from firmware_py.endoscope.targets import GameConfig, TargetGame
from tools.cli.main import app
from tools.research.endoscope.experiment import run_cell
from tools.research.endoscope.play import play, play_on_bench, task_of
from tools.research.endoscope.user import SyntheticUser, UserConfig

BENCH = Path(benches.__file__).with_name("endoscope.toml")


def game(mapping: str = "position", targets: int = 2, seed: int = 1) -> GameConfig:
    return GameConfig(control=ControlConfig(mapping=mapping), targets=targets, seed=seed)  # type: ignore[arg-type]


@pytest.mark.parametrize("mapping", ["position", "speed"])
def test_reaches_the_targets_and_repeats_itself(mapping: str) -> None:
    first, second = (play(UserConfig(seed=4), game(mapping)) for _ in range(2))
    assert first == second
    assert first["done"]
    assert first["reached"] == 2
    assert 5.0 < first["elapsed_s"] < 40.0
    assert max(first["mean_rotation_deg"]) < 31.0
    assert play(UserConfig(seed=5), game(mapping))["elapsed_s"] != first["elapsed_s"]


def test_a_user_who_may_not_finish_says_so() -> None:
    result = play(UserConfig(), game(), limit_s=3.0)
    assert not result["done"]
    assert result["reached"] == 0


def test_the_hand_is_smooth() -> None:
    """Angles, rates and accelerations belong together: what moves the emulated body must not jump."""
    config = game()
    machine = TargetGame(config)
    person = SyntheticUser(UserConfig(tremor_deg=0.3), task_of(config))
    dt = 0.001
    rows = []
    state = machine.state()
    for k in range(4000):
        hand = person.step(state, k * dt)
        state = machine.step(hand.angles_deg, hand.pressed, k * dt)
        rows.append((*hand.angles_deg, *hand.rates_deg_s))
    table = np.array(rows)
    slope = (table[2:, :2] - table[:-2, :2]) / (2 * dt)
    assert np.max(np.abs(slope - table[1:-1, 2:])) < 2.0  # deg/s, where the command steps
    assert np.sqrt(np.mean((slope - table[1:-1, 2:]) ** 2)) < 0.1


def test_slow_response_costs_time() -> None:
    quick, slow = (run_cell("position", tau, UserConfig(), experiments=2).mean_s for tau in (0.25, 2.0))
    assert slow > 1.1 * quick


def test_plays_through_the_wire_as_it_plays_directly() -> None:
    wired = play_on_bench(BENCH, UserConfig(seed=1), game(targets=1), limit_s=60.0)
    direct = play(UserConfig(seed=1), game(targets=1))
    assert wired["experiment"]["done"]
    assert wired["samples"]["lost"] == 0
    assert wired["sensors"]["card"]["masked"] > 0
    # 100 Hz samples, 0.1 s of alignment at each activation, a real filter: about as fast
    assert wired["experiment"]["elapsed_s"] == pytest.approx(direct["elapsed_s"], abs=2.0)


def test_position_mapping_begins_with_an_aimed_movement() -> None:
    """Without noise the hand goes straight to error over gain, and the target is placed without a correction."""
    config = game(targets=1)
    machine = TargetGame(config)
    person = SyntheticUser(UserConfig(aim_spread=0.0, eye_px=0.0, tremor_deg=0.0), task_of(config))
    start = machine.state().off_px
    state, furthest = machine.state(), 0.0
    for k in range(500):
        hand = person.step(state, k * 0.01)
        state = machine.step(hand.angles_deg, hand.pressed, k * 0.01)
        furthest = max(furthest, abs(hand.angles_deg[0]))
    # correcting afterwards may go half a degree further
    assert abs(start[0]) / 8.0 - 0.1 < furthest < abs(start[0]) / 8.0 + 1.0


def test_report_file() -> None:
    text = report_csv("user 7", play(UserConfig(seed=4), game()))
    assert text.startswith("# user user 7\n# mapping position\n# gain 8.0\n")
    rows = [line for line in text.splitlines() if not line.startswith("#")]
    assert rows[0].split(",")[:3] == ["target", "elapsed_s", "clicks"]
    assert len(rows) == 3


def test_command(tmp_path: Path) -> None:
    runner = CliRunner()
    report = tmp_path / "user.csv"
    done = runner.invoke(app, ["endoscope", "play", "--direct", "--targets", "1", "--report", str(report)])
    assert done.exit_code == 0, done.output
    assert report.exists()
    wrong = runner.invoke(app, ["endoscope", "play", "--direct", "--mapping", "force"])
    assert wrong.exit_code == 2
    assert "position or speed" in wrong.output
    late = runner.invoke(app, ["endoscope", "play", "--direct", "--limit", "2"])
    assert late.exit_code == 1
    assert "gave up after 2 s" in late.output
    other = runner.invoke(app, ["endoscope", "play", "--bench", str(Path(benches.__file__).with_name("micron.toml"))])
    assert other.exit_code == 2
    assert "no endoscope bench" in other.output
