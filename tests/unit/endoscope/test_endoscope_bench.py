"""An endoscope bench from file to outcome: wiring, loop, filter, control, faults, in virtual time."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from typer.testing import CliRunner

import benches
from firmware_py.app import run_in_process
from firmware_py.endoscope.wiring import is_endoscope
from firmware_py.recording.reader import Recording
from firmware_py.run_request import RunRequest
from hal.bench import OpenBench, load_bench
from hal.errors import BenchError
from tools.cli.main import app
from tools.reports.endoscope_report import complete_run, inclination_errors_deg

TEXT = """
format = 1
name = "endoscope"
[clock]
tick_hz = 1000
[emulation]
provider = "sim_devices.register:provider"
seed = 3
[emulation.endoscope]
scenario = "{scenario}"
attitude_deg = [10.0, -5.0, 0.0]
poses = {poses}
presses = {presses}
[emulation.imu.imu]
errors = 0.0
noise = 0.0
[emulation.imu.card]
errors = 0.0
noise = 0.0
[bus.i2c0]
kind = "i2c"
uri = "sim://i2c0"
speed_hz = 400_000
[bus.card0]
kind = "serial"
uri = "sim://card0"
baud = 115_200
[device.imu]
driver = "mpu6050"
bus = "i2c0"
address = 0x68
rate_hz = 100
gyro_range_dps = 500.0
[device.card]
driver = "motion_card"
bus = "card0"
rate_hz = 100
[firmware]
{firmware}
"""
# activation at 0.2 s; from 0.8 s roll goes from 10 to 22 degrees within 0.4 s
MOVE = {"scenario": "poses", "poses": "[[0.8, 22.0, -5.0, 0.0, 0.4]]", "presses": "[[0.2, 0.1]]", "firmware": ""}


def bench(folder: Path, **words: str) -> Path:
    path = folder / "bench.toml"
    path.write_text(TEXT.format(**{**MOVE, **words}))
    return path


def run(path: Path, seconds: float = 2.0, **more: Any) -> tuple[dict[str, Any], dict[str, Any]]:
    outcome, truth = run_in_process(RunRequest(path, seconds, pace="virtual"), **more)
    assert truth is not None
    return outcome, truth


def test_which_benches_are_endoscopes() -> None:
    folder = Path(benches.__file__).parent
    names = ("micron", "micron-can", "micron-e727", "endoscope")
    found = [name for name in names if is_endoscope(load_bench(folder / f"{name}.toml").description)]
    assert found == ["endoscope"]


def test_turning_the_card_moves_the_view(tmp_path: Path) -> None:
    outcome, truth = run(bench(tmp_path))
    # 12 degrees at 8 px per degree, response time 0.25 s long over
    expected = 320.0 + 8.0 * 12.0 * (1.0 - (0.25 / 0.26) ** 80)
    assert outcome["view"]["status"] == 1
    assert outcome["view"]["x"] == pytest.approx(expected, abs=4.0)
    assert outcome["view"]["y"] == pytest.approx(240.0, abs=2.0)
    card, imu = outcome["sensors"]["card"], outcome["sensors"]["imu"]
    assert card["received"] == pytest.approx(200, abs=2)
    assert imu["received"] == pytest.approx(200, abs=2)
    assert card["lost"] == imu["lost"] == card["bad_frames"] == 0
    # the wire tells only the change of status: 20 ms from it are two samples
    assert 2 <= card["masked"] <= 3
    assert outcome["safe_state"] == {"reached": True, "reason": "run finished", "normal": True}
    result = complete_run(outcome, truth)
    assert result["attitude"]["imu"]["inclination_rms_deg"] < 0.2
    # the click shakes the card: 20 ms after the press, not filtered on the wire, bend the attitude a little
    assert result["attitude"]["card"]["inclination_rms_deg"] < 1.0
    json.dumps(result)


def test_the_same_run_gives_the_same_numbers(tmp_path: Path) -> None:
    path = bench(tmp_path)
    first, second = (run(path, 1.0)[0] for _ in range(2))
    for outcome in (first, second):
        for task in outcome["tasks"].values():
            task.pop("cpu", None)
    first.pop("tasks")
    second.pop("tasks")
    assert first == second


def test_a_silent_card_holds_the_view_and_ends_the_run(tmp_path: Path) -> None:
    def freeze(opened: OpenBench) -> None:
        opened.clock.at(opened.clock.now_ns() + 1_000_000_000, lambda _: opened.world.inject("freeze", "card"))  # type: ignore[attr-defined, union-attr]

    outcome, _ = run(bench(tmp_path), 3.0, on_open=freeze)
    assert not outcome["safe_state"]["normal"]
    assert "card: no sample for 500 ms" in outcome["safe_state"]["reason"]
    assert 1.0 < outcome["ran_s"] < 1.7


def test_it_records(tmp_path: Path) -> None:
    file = tmp_path / "run.mcap"
    outcome, _ = run_in_process(RunRequest(bench(tmp_path), 1.0, pace="virtual", record=file))
    assert outcome["recorder"] == {"ticks": outcome["sensors"]["card"]["received"], "dropped": 0, "problem": ""}
    recording = Recording(file)
    assert recording.column("view_x")[-1] == pytest.approx(outcome["view"]["x"], abs=1.0)
    assert set(np.unique(recording.column("status"))) == {0.0, 1.0}


def test_bad_tables_are_refused_before_a_device_is_touched(tmp_path: Path) -> None:
    with pytest.raises(BenchError, match=r"firmware.*fusion"):
        run(bench(tmp_path, firmware='fusion = { method = "kalman" }'))
    with pytest.raises(BenchError, match=r"steered_by.*imu, card"):
        run(bench(tmp_path, firmware='steered_by = "ring"'))


def test_inclination_error_of_a_known_tilt() -> None:
    half = np.radians(3.0) / 2
    truth = {"t_ns": np.array([0, 100]), "quaternion": np.array([[1.0, 0, 0, 0], [1.0, 0, 0, 0]])}
    rows = np.array([[50.0, np.cos(half), np.sin(half), 0.0, 0.0], [200.0, 1.0, 0.0, 0.0, 0.0]])
    angles = inclination_errors_deg(rows, truth)
    assert angles[0] == pytest.approx(3.0)
    assert np.isnan(angles[1])


def test_options_of_the_other_instrument_are_refused(tmp_path: Path) -> None:
    arguments = ["run", "--bench", str(bench(tmp_path)), "--virtual", "--hand", "hand.csv"]
    found = CliRunner().invoke(app, arguments)
    assert found.exit_code == 2
    assert "--hand" in found.output


def test_the_run_command_reports(tmp_path: Path) -> None:
    out = tmp_path / "run.json"
    arguments = ["run", "--bench", str(bench(tmp_path)), "--virtual", "--seconds", "1", "--json", str(out)]
    assert CliRunner().invoke(app, arguments).exit_code == 0
    result = json.loads(out.read_text())
    assert result["instrument"] == "endoscope"
    assert "attitudes" not in result
    assert result["attitude"]["imu"]["inclination_rms_deg"] < 0.2
