"""Time columns that are not quite uniform: short gaps and wandering clocks are brought to a grid, with a note."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from tests.recording_text import stack_channels
from tools.errors import InputError, RecordingError
from tools.mismatch.guess import guess
from tools.mismatch.new import new_recording
from tools.mismatch.recording_clock import on_grid
from tools.mismatch.recording_load import load
from tools.mismatch.stamps import StampReader

TEXT = """format = 1
data = "data.npz"
time_column = "t_s"
[twin]
kind = "piezo_stack"
"""


def write(folder: Path, t: np.ndarray) -> Path:
    np.savez(folder / "data.npz", t_s=t, u=np.sin(3 * t), z=np.cos(3 * t))
    (folder / "recording.toml").write_text(TEXT + stack_channels("u", "z"))
    return folder


def test_a_short_gap_is_bridged_and_said(tmp_path: Path) -> None:
    t = np.delete(np.arange(1000) * 0.01, slice(400, 404))
    found = load(write(tmp_path, t))
    assert found.n == 1000
    assert found.dt == pytest.approx(0.01)
    assert found.inputs["command"] == pytest.approx(np.sin(3 * found.t), abs=2e-3)
    assert any("1 gaps, 0.04 s" in w for w in found.warnings)


def test_a_clock_that_wanders_keeps_every_sample_in_time(tmp_path: Path) -> None:
    k = np.arange(2000)
    t = 0.01 * k + 0.03 * np.sin(2 * np.pi * k / 2000)
    found = load(write(tmp_path, t))
    assert found.inputs["command"] == pytest.approx(np.sin(3 * found.t), abs=3 * 0.0052)
    assert any("no gaps" in w for w in found.warnings)


@pytest.mark.parametrize(
    ("name", "factor", "unit"),
    [("t_h", 3600, "h"), ("t_min", 60, "min"), ("hours", 3600, "h"), ("x_min", 60, "min"), ("t_ms", 1e-3, "ms")],
)
def test_a_clock_in_hours_or_minutes_is_converted(tmp_path: Path, name: str, factor: float, unit: str) -> None:
    t = np.arange(500) * 0.01
    np.savez(tmp_path / "data.npz", **{name: t, "u": np.sin(3 * t), "z": np.cos(3 * t)})  # pyright: ignore[reportArgumentType]
    text = TEXT.replace('"t_s"', f'"{name}"') + stack_channels("u", "z")
    (tmp_path / "recording.toml").write_text(text)
    found = load(tmp_path)
    assert found.dt == pytest.approx(0.01 * factor)
    assert any(f"'{name}' is in {unit}: converted to s" in w for w in found.warnings)
    proposed = guess(tmp_path / "data.npz", "piezo_stack")
    # of a column that nobody says is a clock, x_min is the least x
    assert (proposed.clock, proposed.clock_unit) == (("", "s") if name == "x_min" else (name, unit))


def test_rounded_stamps_are_even_for_new_as_they_are_for_simulate(tmp_path: Path) -> None:
    """A sample a minute, in hours with 5 decimals: the usual difference is 60.01 s."""
    k = np.arange(6000)
    data = tmp_path / "data.csv"
    table = np.column_stack([np.round((k + 1) / 60, 5), np.sin(0.03 * k), np.cos(0.03 * k)])
    np.savetxt(data, table, delimiter=",", header="time_h,u_V,z_um", comments="", fmt="%.5f")
    found = load(new_recording(data, kind="piezo_stack").path)
    assert (found.n, found.dt) == (6000, pytest.approx(60.0, rel=1e-6))


@pytest.mark.parametrize("step_s", [0.0027, 0.01 + 1e-5, 60.0])
def test_the_grid_of_stamps_in_blocks_runs_from_the_first_to_the_last(step_s: float) -> None:
    """Stamps in whole ms, or in steps of 0.036 s: their usual difference is not their step."""
    unit_s = 0.036 if step_s == 60.0 else 0.001
    t = np.asarray(np.round(step_s * np.arange(200_000) / unit_s) * unit_s, np.float64)
    reader = StampReader()
    for part in np.split(t, [65536, 131072]):
        reader.add(part)
    stamps = reader.stamps()
    assert stamps.is_even
    assert stamps.wander < 1.1 * unit_s / step_s
    assert stamps.rate_hz == pytest.approx(1 / step_s, rel=1e-6)


def test_a_clock_that_wanders_is_not_even_in_blocks() -> None:
    k = np.arange(200_000)
    reader = StampReader()
    for part in np.split(0.01 * k + 0.02 * np.sin(2 * np.pi * k / k.size), [65536, 131072]):
        reader.add(part)
    assert not reader.stamps().is_even
    assert reader.stamps().wander == pytest.approx(2.0, rel=0.02)


def test_a_long_gap_is_refused(tmp_path: Path) -> None:
    with pytest.raises(RecordingError, match="jumps by 2"):
        load(write(tmp_path, np.delete(np.arange(1000) * 0.01, slice(400, 600))))


def test_noise_is_not_smoothed() -> None:
    rng = np.random.default_rng(1)
    stamps = np.sort(np.arange(4000) + rng.uniform(-0.3, 0.3, 4000))
    noise = rng.standard_normal(4000)
    assert np.std(on_grid(np.arange(4000.0), 1.0, stamps, noise)) == pytest.approx(np.std(noise), rel=0.01)


TWINS = {
    "mechanical_axis": ("force", "N", "position", "mm", "mass = 2.0\ndamping = 6.0\nstiffness = 120.0"),
    "state_space": ("u", "V", "y", "V", "A = [[-3.0]]\nB = [[3.0]]\nC = [[1.0]]"),
    "ode": ("u", "V", "y", "V", 'rate = 3.0\nstates = { y = "V" }\nequations = { y = "rate * (u - y)" }'),
}


@pytest.mark.parametrize("kind", TWINS)
@pytest.mark.parametrize("is_in_ms", [True, False])
def test_a_time_in_ms_under_a_bare_name_is_noticed(tmp_path: Path, kind: str, is_in_ms: bool) -> None:
    drive, drive_unit, answer, unit, parameters = TWINS[kind]
    t_s = np.arange(600) * 0.01
    scale = 1e3 if is_in_ms else 1.0
    np.savez(tmp_path / "data.npz", t=scale * t_s, u=np.sin(3 * t_s), y=np.cos(3 * t_s))
    (tmp_path / "recording.toml").write_text(
        f'format = 1\ndata = "data.npz"\ntime_column = "t"\n[twin]\nkind = "{kind}"\n[twin.parameters]\n{parameters}\n'
        f'[[channels]]\ncolumn = "u"\nrole = "input"\nsignal = "{drive}"\nunit = "{drive_unit}"\n'
        f'[[channels]]\ncolumn = "y"\nrole = "output"\nsignal = "{answer}"\nunit = "{unit}"\n'
    )
    notes = [note for note in load(tmp_path).warnings if "if the column is in ms" in note.lower()]
    assert len(notes) == is_in_ms
    assert all("rate_hz = 100 in place of time_column" in note for note in notes)


CURVE = 'outputs = { y = "gain * u" }\ngain = 3.0'


@pytest.mark.parametrize(("parameters", "notes"), [(TWINS["ode"][4], 1), (CURVE, 0)])
def test_a_clock_in_hours_raises_no_doubt_of_its_unit(tmp_path: Path, parameters: str, notes: int) -> None:
    """The samples may still be too far apart for the twin, which a curve has no opinion on."""
    k = np.arange(600)
    np.savez(tmp_path / "data.npz", t_h=0.01 * k, u=np.sin(0.03 * k), y=np.cos(0.03 * k))
    (tmp_path / "recording.toml").write_text(
        f'format = 1\ndata = "data.npz"\ntime_column = "t_h"\n[twin]\nkind = "ode"\n[twin.parameters]\n{parameters}\n'
        '[[channels]]\ncolumn = "u"\nrole = "input"\nsignal = "u"\nunit = "V"\n'
        '[[channels]]\ncolumn = "y"\nrole = "output"\nsignal = "y"\nunit = "V"\n'
    )
    found = [note for note in load(tmp_path).warnings if "samples are 36 s apart" in note]
    assert len(found) == notes
    assert all(note.endswith("check the units of the twin's time constants") for note in found)


@pytest.mark.parametrize(("name", "unit_s"), [("t_s", 1.0), ("t_h", 3600.0)])
def test_new_takes_the_stamps_that_simulate_takes(tmp_path: Path, name: str, unit_s: float) -> None:
    """Short gaps are filled in either unit, long ones are refused by both."""
    k = np.arange(1000)
    columns = {"u": np.sin(0.03 * k), "z": np.cos(0.03 * k)}

    def data_without(missing: slice) -> Path:
        path = tmp_path / f"{missing.stop}.npz"
        np.savez(path, **{n: np.delete(x, missing) for n, x in {name: 60.0 * k / unit_s, **columns}.items()})  # pyright: ignore[reportArgumentType]
        return path

    assert guess(data_without(slice(400, 404)), "piezo_stack").time_column == name
    found = load(new_recording(data_without(slice(400, 404)), kind="piezo_stack").path)
    assert (found.n, found.dt) == (1000, pytest.approx(60.0))
    with pytest.raises(InputError, match="jumps by"):
        new_recording(data_without(slice(400, 600)), kind="piezo_stack", force=True)
