"""Twins of somebody else in the blind proof: an FMU, a user's package, the whole bench."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from hal import plugins
from hal.trust import require_package
from tools.errors import RecordingError
from tools.mismatch import units
from tools.mismatch.recording_load import load
from tools.mismatch.simulate import Model
from tools.mismatch.simulate_view import View
from tools.mismatch.twins.make import make
from tools.research.prove import draw, guests
from tools.research.prove.disk import contract_unit
from tools.research.prove.plans import plans
from tools.research.prove.proof import draw_one, generate


@pytest.mark.parametrize("kind", [guests.FMU, guests.USER, guests.INSTRUMENT])
def test_the_files_beside_a_recording_hold_the_twin_that_made_it(tmp_path: Path, kind: str) -> None:
    """What the tool finds on disk, run as the tool runs it, differs from the recording by the sealed noise alone."""
    if kind == guests.FMU and not guests.fmu_possible():
        pytest.skip("the extra 'fmu' is not installed")
    paths, answers = generate(5, [draw.Plan("agrees", kind, (), 4.0)], tmp_path / "recordings", each_noise=["white"])
    (path,) = paths.values()
    with guests.installed(path):
        rec = load(path)
        model = Model(make(rec))
        simulated = model.simulate(View.whole(rec), model.start(rec))
    with np.load(tmp_path / "sealed" / "r000.npz") as sealed:
        for o, y in simulated.items():
            left = units.convert_difference(rec.outputs[o] - y, rec.unit[o], contract_unit(o))
            noise = answers["r000"]["noise_rms"][o]
            np.testing.assert_allclose(left, sealed[o][: rec.n], atol=1e-3 * noise)


def test_a_users_package_is_there_while_it_is_installed_and_gone_afterwards(tmp_path: Path) -> None:
    paths, _ = generate(2, [draw.Plan("agrees", guests.USER, (), 4.0)], tmp_path / "recordings")
    (path,) = paths.values()
    with guests.installed(path):
        assert guests.USER in plugins.offered(plugins.TWINS)
    assert guests.USER not in plugins.offered(plugins.TWINS)
    with pytest.raises(RecordingError, match=f"kind '{guests.USER}' is unknown"):
        load(path)


def test_a_users_package_beside_relative_paths_is_the_one_that_was_trusted(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    guests.install_user_twin(Path("block"))
    with guests.installed(Path("block") / "recordings" / "r000" / "recording.toml"):
        require_package("lever_arm:LeverArm", Path("recording.toml"))


def test_without_the_extra_a_case_of_an_fmu_is_left_out(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(guests.importlib.util, "find_spec", lambda name: None)
    job = (1, 0, draw.Plan("agrees", guests.FMU, (), 4.0), tmp_path / "recordings", 3000, None)
    assert draw_one(job) is None
    assert not tmp_path.joinpath("recordings").exists()


def test_every_kind_of_twin_is_drawn() -> None:
    drawn = {p.twin for p in plans(3, 200)}
    assert {guests.FMU, guests.USER, guests.INSTRUMENT} < drawn
