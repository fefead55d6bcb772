"""The page on real hands, its text, and the commands that train and report."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from tests.command import micron
from tools.errors import InputError
from tools.research.reproduce.tremor_hands import PUBLISHED_CROSS
from tools.research.tremor.cascade import Cascade
from tools.research.tremor.cascade_data import RATE_HZ, Making, learning_paths, subjects, voluntary
from tools.research.tremor.cascade_file import load_network
from tools.research.tremor.report import filled, report, table
from tools.research.tremor.report_detectors import detection, jerk_acceleration
from tools.research.tremor.shaker import _held_out
from tools.research.tremor.signal import TremorSignal


def test_paragraphs_are_filled_and_tables_left_alone() -> None:
    lines = filled(["## head", "", "some words", "and " * 40, "", *table(["a", "b"], [["1", "2"]]), "end"])
    assert lines[:2] == ["## head", ""]
    assert all(len(line) <= 118 for line in lines)
    assert lines[-4:] == ["| a | b |", "|---|---:|", "| 1 | 2 |", "end"]


def test_report_without_recordings(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match="no tremor recordings"):
        report(tmp_path, "x", lambda _: None)


def test_published_mean_of_table_5_3() -> None:
    assert np.mean(PUBLISHED_CROSS) == pytest.approx(-12.633, abs=0.01)


def test_limit_is_judged_where_it_was_not_chosen() -> None:
    rng = np.random.default_rng(1)
    truth = rng.random(400) < 0.3
    assert np.array_equal(_held_out(np.where(truth, 0.6, 0.2) + 0.05 * rng.random(400), truth), truth)
    said = _held_out(rng.random(400), truth)
    assert abs(np.mean(said[truth]) - np.mean(said[~truth])) < 0.2  # nothing to learn, nothing claimed


def hand(seconds: float = 84.0) -> TremorSignal:
    rng = np.random.default_rng(2)
    t_s = np.arange(int(seconds * 64)) / 64.0
    turn = 2 * np.pi * 9.0 * t_s + 2.0 * np.sin(0.3 * t_s)
    values = np.stack([np.sin(turn), 0.1 * rng.standard_normal(len(t_s))], axis=1)
    return TremorSignal("made", "made", "someone", "angular rate", "rad/s", ("x", "y"), values, 64.0, 64.0)


def test_files_are_made_as_stated() -> None:
    making = Making()
    (person,) = subjects([hand()], making)
    assert [len(e) for e in person.errors] == [4000] * 5
    assert np.mean([np.std(e) for e in person.errors]) == pytest.approx(making.error_rms_m, rel=0.01)
    slow = voluntary(making, 3)
    assert np.sqrt(np.mean(slow**2)) == pytest.approx(making.error_rms_m)
    power = np.abs(np.fft.rfft(slow * np.hanning(4000))) ** 2
    hz = np.fft.rfftfreq(4000, 1.0 / RATE_HZ)
    assert power[hz > 2.0].sum() < 0.01 * power.sum()
    assert not np.allclose(voluntary(making, 3), voluntary(making, 4))


def test_validation_shares_nothing_with_fitting() -> None:
    making = Making()
    error = np.arange(4000.0)
    fit, hold = learning_paths([error], making, 2)
    assert [len(m) for m, _ in fit.pairs] == [3000, 3000]
    assert [len(m) for m, _ in hold.pairs] == [1000, 1000]
    motions = [w[:500] for _, w in (*fit.pairs, *hold.pairs)]
    assert not any(np.allclose(a, b) for n, a in enumerate(motions) for b in motions[:n])


def test_jerk_is_the_second_derivative_of_its_path() -> None:
    t_s = np.arange(0.0, 1.0, 1e-4)
    s = np.clip((t_s - 0.2) / 0.035, 0.0, 60.0)
    path = 80e-6 * (s / 3.0) ** 3 * np.exp(3.0 - s)
    numeric = np.gradient(np.gradient(path, t_s), t_s)
    np.testing.assert_allclose(jerk_acceleration(t_s, 0.2, 80e-6, 0.035)[5:-5], numeric[5:-5], atol=3e-4)


def test_detection_of_large_jerks_in_noise() -> None:
    found = detection(0.02 * np.random.default_rng(3).standard_normal((40_000, 3)), 400e-6, 0.035)
    assert found.share == 1.0
    assert found.late_s < 0.2


def test_train_command_writes_weights_that_run(tmp_path: Path) -> None:
    file = tmp_path / "hand.csv"
    made = hand()
    rows = "\n".join(f"{t:.5f},{x:.5f},{y:.5f}" for t, (x, y) in zip(made.t_s, made.values, strict=True))
    file.write_text("t_s,gyro_x_rad_s,gyro_y_rad_s\n" + rows)
    out, found = tmp_path / "net.json", tmp_path / "found.json"
    command = ["tremor", "train", str(file), "--window", "20", "--units", "0", "--out", str(out), "--json", str(found)]
    result = micron(*command)
    assert result.exit_code == 0, result.output
    (row,) = json.loads(found.read_text())["rows"]
    assert row["percent"] > 60.0
    network = load_network(out)
    assert network.centred
    assert np.all(np.isfinite(Cascade(network).run(np.zeros(100))))
    again = tmp_path / "again.json"
    tested = micron("tremor", "train", file, "--weights", out, "--json", again)
    assert tested.exit_code == 0, tested.output
    assert json.loads(again.read_text())["rows"][0]["percent"] > 60.0


@pytest.mark.parametrize("extra", [["--leave-out", "nobody"], ["--window", "400", "--spacing", "20"]])
def test_train_command_refuses(tmp_path: Path, extra: list[str]) -> None:
    made = hand()
    file = tmp_path / "hand.csv"
    file.write_text(
        "t_s,gyro_x_rad_s\n" + "\n".join(f"{t:.5f},{v[0]:.5f}" for t, v in zip(made.t_s, made.values, strict=True))
    )
    result = micron("tremor", "train", file, "--out", tmp_path / "net.json", *extra)
    assert result.exit_code == 2, result.output
    assert not (tmp_path / "net.json").exists()


def test_a_section_is_made_again_and_the_others_stay(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    from tools.research.tremor import report as pages
    from tools.research.tremor import report_inspect

    monkeypatch.setattr(pages, "_signals", lambda data: [hand()])
    monkeypatch.setattr(report_inspect, "section", lambda signals, progress: ["## Two", "", "new"])
    page = "# Page\n\n## One\n\nkept\n\n## Two\n\nold\n\n### Part\n\nold\n\n## Three\n\nkept too\n"
    made = pages.renewed(page, "inspect", tmp_path, "abc", lambda _: None)
    assert made == (
        "# Page\n\n## One\n\nkept\n\n## Two\n\nThis section: revision abc.\n\nnew\n\n## Three\n\nkept too\n"
    )
    with pytest.raises(InputError, match="no section '## Two'"):
        pages.renewed("# Page\n", "inspect", tmp_path, "abc", lambda _: None)
    done = micron("tremor", "report", "--section", "inspect", "--out", tmp_path / "no.md")
    assert done.exit_code == 2
    assert "--out FILE" in done.output
