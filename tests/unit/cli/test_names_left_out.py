"""Names that belong to nothing, and columns that nobody reads, are said."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from tests.command import micron
from tests.recording_text import channel
from tools.mismatch.recording_load import columns_left_out, load

TEXT = (
    """format = 1
data = "data.npz"
rate_hz = 200.0
[twin]
kind = "ode"
[twin.states]
angle = "rad"
[twin.equations]
angle = "slope * current - back * angle"
[twin.outputs]
angle = "angle"
angel = "2 * angle"
[twin.units]
slope = "rad/(A s)"
sloep = "rad/(A s)"
current = "A"
angle_offset = "rad"
[twin.parameters]
slope = 2.0
back = 1.0
unread = 3.0
fixed = ["back"]
hold = "zero"
"""
    + channel("u", "input", "current", "A")
    + channel("y", "output", "angle", "rad")
)


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    t = np.arange(300) / 200.0
    np.savez(tmp_path / "data.npz", u=np.sin(t), y=np.sin(t - 0.3), spare=np.cos(t))
    (tmp_path / "recording.toml").write_text(TEXT)
    monkeypatch.chdir(tmp_path)
    return tmp_path


def test_names_of_an_ode_that_belong_to_nothing_are_noted(folder: Path) -> None:
    assert load(folder).warnings == (
        "[twin.outputs] angel: no channel is this output; not used",
        "[twin.units] sloep: no signal or parameter has this name; not used",
        "[twin.parameters] unread: no equation has this name; not used",
    )


def test_columns_that_no_channel_reads_are_named(folder: Path) -> None:
    assert columns_left_out(folder) == ["spare"]
    done = micron("mismatch", "simulate", ".")
    assert done.exit_code == 0, done.output
    assert "columns not used: spare" in done.stderr
