"""A recording with gaps and an irregular clock becomes one that can be diagnosed."""

from __future__ import annotations

import errno
import os
from pathlib import Path

import numpy as np
import pytest

from tests.recording_text import stack_channels
from tools.errors import InputError, OutputError, RecordingError
from tools.mismatch.cut import cut, cut_columns
from tools.mismatch.recording_load import load

TEXT = """format = 1
title = "a stack"
data = "data.csv"
{clock}

[twin]
kind = "piezo_stack"
[twin.parameters]
gain_um_per_V = 0.12

[split]
fit = [0, 300]

""" + stack_channels("u", "z")


def write(folder: Path, t: np.ndarray, u: np.ndarray, clock: str) -> Path:
    rows = [f"{a:.9f},{b:.9f},{0.12 * b + 0.01:.9f}" for a, b in zip(t, u, strict=True)]
    (folder / "data.csv").write_text("\n".join(["t,u,z", *rows]))
    (folder / "recording.toml").write_text(TEXT.format(clock=clock))
    return folder


def test_the_longest_stretch_is_kept_on_a_uniform_clock(tmp_path: Path) -> None:
    rng = np.random.default_rng(0)
    t = np.concatenate([np.arange(200) * 0.01, 10 + np.arange(600) * 0.01])
    t[1:] += rng.uniform(-0.001, 0.001, 799)
    u = np.sin(t)
    u[700:703] = np.nan
    folder = write(tmp_path, t, u, 'time_column = "t"')
    with pytest.raises(RecordingError, match="micron mismatch cut RECORDING --out FOLDER"):
        load(folder)
    kept = cut(folder, tmp_path / "new")
    assert (kept.parts, kept.samples) == (2, 600)
    assert kept.rate_hz == pytest.approx(100, rel=1e-3)
    assert 1 <= kept.filled <= 4
    found = load(tmp_path / "new")
    assert found.n == 600
    assert found.split.fit is None
    grid = kept.start_s + np.arange(600) / kept.rate_hz
    np.testing.assert_allclose(found.inputs["command"], np.sin(grid), atol=0.012)
    assert found.twin.parameters == {"gain_um_per_V": 0.12}


def test_a_gap_in_a_record_without_a_clock_and_a_wanted_part(tmp_path: Path) -> None:
    u = np.sin(np.arange(900) * 0.01)
    u[400:500] = np.nan
    folder = write(tmp_path, np.arange(900) * 0.01, u, "rate_hz = 100.0")
    kept = cut(folder, tmp_path / "late")
    assert (kept.samples, kept.parts, kept.filled) == (400, 2, 0)
    assert cut(folder, tmp_path / "early", stop_s=3.0).samples == 300
    np.testing.assert_allclose(load(tmp_path / "late").inputs["command"], u[:400], atol=1e-8)
    with pytest.raises(InputError, match="usable samples"):
        cut(folder, tmp_path / "none", start_s=8.9)
    assert not (tmp_path / "none").exists()


def test_every_stretch_is_kept_as_a_run_of_its_own(tmp_path: Path) -> None:
    t = np.concatenate([np.arange(200) * 0.01, 10 + np.arange(600) * 0.01, 20 + np.arange(12) * 0.01])
    folder = write(tmp_path, t, np.sin(t), 'time_column = "t"')
    kept = cut(folder, tmp_path / "new", every=True)
    assert (kept.parts, kept.kept, kept.samples) == (3, 2, 800)
    found = load(tmp_path / "new")
    assert (found.n, found.segments) == (800, (200,))
    np.testing.assert_allclose(found.inputs["command"], np.sin(t[:800]), atol=1e-6)
    again = cut(tmp_path / "new", tmp_path / "longest")
    assert (again.parts, again.kept, again.samples) == (2, 1, 600)
    np.testing.assert_allclose(load(tmp_path / "longest").inputs["command"], np.sin(t[200:800]), atol=1e-6)


@pytest.mark.parametrize(
    ("segments", "message"),
    [("3", "must be a list of samples"), ("[10]", "a run of 10 of the 300"), ("[200, 100]", "rising order")],
)
def test_segments_that_mean_nothing_are_refused(tmp_path: Path, segments: str, message: str) -> None:
    t = np.arange(300) * 0.01
    folder = write(tmp_path, t, np.sin(t), f"rate_hz = 100.0\nsegments = {segments}")
    with pytest.raises(RecordingError, match=message):
        load(folder)


def test_a_cut_does_not_replace_its_recording(tmp_path: Path) -> None:
    t = np.arange(400) / 100.0
    folder = write(tmp_path, t, np.sin(t), 'time_column = "t"')
    before = {p.name: p.read_bytes() for p in folder.iterdir()}
    with pytest.raises(InputError, match="name another folder"):
        cut(folder, folder / ".." / folder.name)
    assert {p.name: p.read_bytes() for p in folder.iterdir()} == before


def test_a_rate_that_makes_more_samples_than_a_recording_may_have_is_refused(tmp_path: Path):
    t = np.arange(300) / 100.0
    with pytest.raises(InputError, match=r"2\.69e\+09 samples at 9e\+08 Hz; at most 50000000 are made"):
        cut_columns(tmp_path / "data.csv", t, {"x": np.sin(t)}, rate_hz=9e8)


@pytest.mark.parametrize("is_there", [False, True])
def test_a_cut_is_written_whole_or_not_at_all(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, is_there: bool) -> None:
    t = np.arange(300) * 0.01
    folder, new = write(tmp_path, t, np.sin(t), "rate_hz = 100.0"), tmp_path / "new"
    if is_there:
        new.mkdir()
        (new / "remarks.txt").write_text("mine")
    before = sorted(tmp_path.rglob("*"))

    def fail(*_: object) -> str:
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    with monkeypatch.context() as full:
        full.setattr("tools.mismatch.cut.toml_text", fail)
        with pytest.raises(OutputError, match=r"new: cannot be written \(No space left on device\); free some space"):
            cut(folder, new)
    assert sorted(tmp_path.rglob("*")) == before
    cut(folder, new)
    assert sorted(f.name for f in new.iterdir()) == ["data.npz", "recording.toml", *["remarks.txt"] * is_there]
    assert new.stat().st_mode & 0o055 == 0o055


@pytest.mark.parametrize(
    ("old", "new", "says"),
    [
        ('column = "u"', "column = 3", r"\[\[channels\]\] 1: 'column' is missing or not a text"),
        ("rate_hz = 100.0", 'rate_hz = "fast"', "rate_hz must be a finite number, got 'fast'"),
        ("rate_hz = 100.0", "rate_hz = 100.0\nsegments = ['a']", "segments must be a list of samples"),
        ("rate_hz = 100.0", "", "neither 'rate_hz' nor 'time_column'"),
    ],
)
def test_a_descriptor_that_cannot_be_cut_is_named(tmp_path: Path, old: str, new: str, says: str) -> None:
    t = np.arange(300) * 0.01
    folder = write(tmp_path, t, np.sin(t), "rate_hz = 100.0")
    text = (folder / "recording.toml").read_text()
    (folder / "recording.toml").write_text(text.replace(old, new, 1))
    with pytest.raises(RecordingError, match=says):
        cut(folder, tmp_path / "new")
    assert not (tmp_path / "new").exists()
