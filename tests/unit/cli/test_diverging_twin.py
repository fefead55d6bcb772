"""``micron mismatch simulate`` says at which sample a twin diverges, and writes nothing."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from tests.command import micron
from tests.recording_text import channel
from tools.errors import RecordingError
from tools.mismatch.recording_load import load
from tools.mismatch.simulate_bounds import run_bounded

TEXT = (
    """format = 1
data = "data.npz"
rate_hz = 200.0
[twin]
kind = "state_space"
[twin.parameters]
A = [[0.0, 1.0], [{stiffness}, {damping}]]
B = [[0.0], [0.5]]
C = [[1.0, 0.0]]
"""
    + channel("u", "input", "force", "N")
    + channel("y", "output", "position", "mm")
)


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    t = np.arange(3000) / 200.0
    np.savez(tmp_path / "data.npz", u=np.sin(t), y=np.sin(t - 0.3))
    monkeypatch.chdir(tmp_path)
    return tmp_path


def describe(folder: Path, stiffness: float, damping: float) -> None:
    (folder / "recording.toml").write_text(TEXT.format(stiffness=stiffness, damping=damping))


@pytest.mark.parametrize("damping", [30.0, 3000.0])
@pytest.mark.filterwarnings("error")
def test_a_twin_that_grows_without_bound_is_refused(folder: Path, damping: float) -> None:
    describe(folder, -57.0, damping)
    done = micron("mismatch", "simulate", ".", "--out", "simulated.csv", "--json", "figures.json")
    assert done.exit_code == 2, done.exception
    last = done.stderr.splitlines()[-1]
    assert last.startswith("micron: .: the twin diverges: its position is ")
    assert "s); check its parameters, their signs and units" in last
    assert done.stdout == ""
    assert not {"simulated.csv", "figures.json"} & {p.name for p in folder.iterdir()}


def test_a_twin_that_stays_bounded_is_as_before(folder: Path) -> None:
    describe(folder, -57.0, -2.5)
    done = micron("mismatch", "simulate", ".")
    assert done.exit_code == 0, done.output
    assert "position: residual" in done.stdout


def test_outputs_of_another_shape_and_twins_without_a_solution_are_refused(folder: Path) -> None:
    describe(folder, -57.0, -2.5)
    loaded = load(folder)

    def singular() -> dict[str, np.ndarray]:
        raise np.linalg.LinAlgError("Singular matrix")

    with pytest.raises(RecordingError, match=r"twin\.py: gives position with the shape \(30,\); .* 3000 samples"):
        run_bounded(Path("twin.py"), loaded, lambda: {"position": np.zeros(30)})
    with pytest.raises(RecordingError, match=r"position is nan mm at sample 0 \(0 s\)"):
        run_bounded(Path("twin.py"), loaded, lambda: {"position": np.full(3000, np.nan)})
    with pytest.raises(RecordingError, match=r"cannot be run \(Singular matrix\)"):
        run_bounded(Path("twin.toml"), loaded, singular)
