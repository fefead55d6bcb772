"""The actuation commands as a user runs them: files, tables, JSON, exit codes; and what each refuses."""

from __future__ import annotations

import json
import tomllib
from functools import partial
from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner, Result

from firmware_py.actuation.config import ActuationConfig, StackConfig
from sim_devices.plant.lab import main as lab
from tests.recording_text import stack_channels
from tests.unit.actuation.excitation import excitation_V
from tools.calibrate.piezo import identify_stack
from tools.calibrate.piezo_prediction import command, predict, simulate, tremor_profile_um
from tools.cli.main import app
from tools.mismatch.recording import Recording, Split, TwinText
from tools.research.manipulator import workspace
from tools.research.reproduce import actuation, names
from tools.research.reproduce.actuation_lab import Controller, Tracking
from tools.research.reproduce.rows import Row, Table

RATE_HZ = 1000.0
TOML = """format = 1
title = "test"
data = "data.npz"
rate_hz = 1000.0

[twin]
kind = "piezo_stack"
[twin.parameters]
gain_um_per_V = 0.15
offset_um = 0.0
"""


def run(*arguments: str) -> Result:
    return CliRunner(env={"COLUMNS": "200"}).invoke(app, list(arguments))


def stack_recording(noise_um: float = 0.0) -> tuple[np.ndarray, np.ndarray]:
    drive = excitation_V(RATE_HZ, 5.0)
    noise = noise_um * np.random.default_rng(1).standard_normal(len(drive))
    return drive, simulate(StackConfig(), drive) + noise


@pytest.fixture
def stack(tmp_path: Path) -> Path:
    folder = tmp_path / "stack"
    folder.mkdir()
    drive, z = stack_recording(0.01)
    np.savez(folder / "data.npz", command_V=drive, displacement_um=z)
    (folder / "recording.toml").write_text(TOML + stack_channels("command_V", "displacement_um"))
    return folder


def test_calibrate_piezo_writes_what_the_firmware_loads(stack: Path, tmp_path: Path) -> None:
    out, found = tmp_path / "piezo.toml", tmp_path / "fit.json"
    done = run("calibrate", "piezo", str(stack), "--out", str(out), "--json", str(found))
    assert done.exit_code == 0, done.output
    config = ActuationConfig.from_dict(tomllib.loads(out.read_text())["actuation"])
    assert len(set(config.stacks)) == 1
    result = json.loads(found.read_text())
    assert result["stacks"][0]["held_out_rms_um"] < 0.02
    # no lag, and a drive that is not said to be held: half a tick of the firmware's own hold is what is left
    assert config.preview_s == pytest.approx(0.5e-3)
    assert result["feedforward"]["preview_s"] == config.preview_s
    assert "missing" in done.output
    assert "no resonance was found: steps of a few volts" in done.output


def test_calibrate_piezo_refuses(stack: Path, tmp_path: Path) -> None:
    out = tmp_path / "piezo.toml"
    two = run("calibrate", "piezo", str(stack), str(stack), "--out", str(out))
    assert two.exit_code == 2
    assert "give one stack (for all three) or three" in two.output
    empty = tmp_path / "empty"
    empty.mkdir()
    assert "neither a recording" in run("calibrate", "piezo", str(empty), "--out", str(out)).output
    assert not out.exists()


def test_steps_alone_are_no_calibration(tmp_path: Path) -> None:
    folder = tmp_path / "steps"
    assert lab(["piezo", "--profile", "steps", "--rate-hz", "10", "--seconds", "0.5", "--out", str(folder)]) == 0
    done = run("calibrate", "piezo", str(folder), "--out", str(tmp_path / "piezo.toml"))
    assert done.exit_code == 2
    assert "steps show lag and resonance only" in done.output


def test_calibrate_manipulator_from_the_labs_scan(tmp_path: Path) -> None:
    scan, out, found = tmp_path / "scan", tmp_path / "manipulator.toml", tmp_path / "fit.json"
    assert lab(["manipulator", "--per-axis", "3", "--out", str(scan), "--unit", "2"]) == 0
    done = run("calibrate", "manipulator", str(scan), "--out", str(out), "--json", str(found))
    assert done.exit_code == 0, done.output
    assert "27 positions" in done.output
    ActuationConfig.from_dict(tomllib.loads(out.read_text())["actuation"])
    result = json.loads(found.read_text())
    assert max(result["residual_um"]) < 0.2 * max(result["before_um"])


def test_calibrate_manipulator_refuses(tmp_path: Path) -> None:
    (tmp_path / "data.npz").write_bytes(b"no archive")
    done = run("calibrate", "manipulator", str(tmp_path), "--out", str(tmp_path / "m.toml"))
    assert done.exit_code == 2
    assert "cannot be read as .npz" in done.output
    assert not (tmp_path / "m.toml").exists()


def test_workspace_prints_and_draws(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(workspace, "analyse", partial(workspace.analyse, grid=5))
    picture, found = tmp_path / "workspace.png", tmp_path / "w.json"
    done = run("manipulator", "--out", str(picture), "--json", str(found))
    assert done.exit_code == 0, done.output
    assert picture.read_bytes()[:4] == b"\x89PNG"
    result = json.loads(found.read_text())
    assert result["extent_m"][0] > 1e-3
    assert result["sphere_m"] > 100e-6
    assert result["newton"] <= 3


def test_workspace_refuses_a_bench_that_is_none(tmp_path: Path) -> None:
    bench = tmp_path / "bench.toml"
    bench.write_text("format = 1\nname = 'x'\n[firmware.actuation]\nshaft_m = -1.0\n")
    done = run("manipulator", "--bench", str(bench), "--out", str(tmp_path / "w.png"))
    assert done.exit_code == 2
    assert "shaft_m" in done.output
    assert not (tmp_path / "w.png").exists()


def test_reproduce_prints_rows_and_refuses_a_name(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    rows = (
        Row("Ang 2004, Table 7.3", "rms error, ours", "%", "hand", 1.4, 0.7, "lower", "emulated"),
        Row(
            "Ang 2004, Table 7.3",
            "rms error, without model",
            "%",
            "hand",
            8.3,
            8.2,
            "higher",
            "emulated",
            why="smaller",
        ),
    )
    monkeypatch.setattr(actuation, "table", lambda: Table("actuation", rows, 1.0, ("a note",)))
    out = tmp_path / "actuation.json"
    done = run("reproduce", "actuation", "--json", str(out))
    assert done.exit_code == 0
    assert "1 of 2 met" in done.output
    assert [row["meets"] for row in json.loads(out.read_text())["rows"]] == [True, False]
    wrong = run("reproduce", "actuatoin")
    assert wrong.exit_code == 2
    assert "'actuatoin' is no table" in wrong.output
    assert names.MODULES["actuation"] == "tools.research.reproduce.actuation"


def test_rows_put_each_way_beside_its_column(monkeypatch: pytest.MonkeyPatch) -> None:
    """Controllers stand in for stacks: every way is tracked with its own errors and judged in its direction."""
    errors = {0: (1.5, 2.7), 1: (0.3, 0.9), 2: (0.2, 0.6), 3: (0.1, 0.3)}
    monkeypatch.setattr(actuation, "ways", lambda kind: [kind])
    monkeypatch.setattr(actuation, "all_runs", lambda paths, by: [Tracking(*errors[by[0]], 9.0, 9.0, 0)] * 3)
    rows = actuation.table_7_1()
    assert len(rows) == 4 * 2 * 8
    first = [row for row in rows if row.condition.startswith("1 Hz")]
    assert [row.published for row in first] == [1.13, 2.11, 0.25, 0.63, 0.21, 0.57, 0.21, 0.57]
    assert [row.ours for row in first] == pytest.approx([1.5, 2.7, 0.3, 0.9, 0.2, 0.6, 0.1, 0.3])
    assert [row.meets for row in first] == [True, True, False, False, True, False, True, True]
    assert all(row.better == ("higher" if "without" in row.quantity else "lower") for row in rows)
    assert Controller(None).taps == (1.0,)


def test_prediction_is_what_noise_and_unseen_recordings_leave() -> None:
    """A stack of the model's own form: tracking of the tremor is predicted at the noise, no more and not less."""
    drive, z = stack_recording(0.05)
    recording = Recording(
        path=Path("r"), title="", t=np.arange(len(drive)) / RATE_HZ, dt=1.0 / RATE_HZ, inputs={"command": drive},
        outputs={"displacement": z}, context={}, noise={"displacement": None}, unit={}, column={},
        twin=TwinText("piezo_stack", {}), split=Split(),
    )  # fmt: skip
    fit = identify_stack(recording)
    expected = predict(fit)
    assert expected.wanted_um == pytest.approx(0.8 * fit.range_um, rel=0.1)
    assert 0.05 <= expected.rms_um < 0.08
    assert expected.max_um > 3 * 0.05
    assert expected.limited_ticks == 0
    wanted = tremor_profile_um(10.0)
    assert np.ptp(wanted) == pytest.approx(10.0)
    assert wanted[0] == 0.0
    # 8 to 12 Hz and nothing else
    power = np.abs(np.fft.rfft((wanted - wanted.mean()) * np.hanning(len(wanted)))) ** 2
    hz = np.fft.rfftfreq(len(wanted), 1e-3)
    assert power[(hz > 7.5) & (hz < 12.5)].sum() > 0.98 * power.sum()


def test_beyond_36_hz_the_slopes_are_held_counted_and_the_drive_stays_monotonic() -> None:
    """Ang 2004, 7.5: 12.5 um p-p is singular at about 36 Hz (1414 um/s). The first slope reaches zero there; driven
    past it, the command is still one that a stack of this model follows at the held slope."""
    first = StackConfig().play_weights_um_per_V[0]
    stack = StackConfig(slope_per_rate_s_per_V=(-first / 1414.0, *[0.0] * 9))
    t = np.arange(1000) / RATE_HZ

    def driven(hz: float):
        return command(stack, 6.25 * np.sin(2 * np.pi * hz * t) * np.minimum(1.0, t / 0.2))

    assert driven(34.0).singular == 0
    past = driven(40.0)
    assert past.singular > 0
    assert past.voltage == 0
    assert past.slew == 0
    assert np.all((past.drive_V >= 0.0) & (past.drive_V <= 100.0))
    # of each period only the fast part: 2 x (1 - 2/pi asin(rate at the limit / top rate)) of it at full size
    limit = 2.0 / np.pi * np.arcsin((first - stack.least_slope_um_per_V) / first * 1414.0 / (2 * np.pi * 40.0 * 6.25))
    assert past.singular == pytest.approx(800 * (1.0 - limit), rel=0.08)
    wanted = np.diff(np.sin(2 * np.pi * 40.0 * t))[300:]
    moved = np.diff(past.drive_V)[300:]
    assert np.all(np.sign(moved)[np.abs(wanted) > 0.05] == np.sign(wanted)[np.abs(wanted) > 0.05])
