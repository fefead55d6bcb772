"""FMUs for model exchange (built here with the C compiler): linear ones show their equations, others are refused."""

from __future__ import annotations

import shutil
import subprocess
import sys
import zipfile
from pathlib import Path

import numpy as np
import pytest

from hal.trust import trust_program
from tools.errors import RecordingError
from tools.guest.fmu_linear import linear_map
from tools.mismatch.engine.reach import not_tried
from tools.mismatch.export.run import free_run
from tools.mismatch.recording_load import load
from tools.mismatch.twins.fmu import with_equations
from tools.mismatch.twins.make import make
from tools.mismatch.twins.ode import OdeTwin

pytest.importorskip("fmpy", reason="the extra 'fmu' is not installed")
pytestmark = pytest.mark.skipif(shutil.which("cc") is None, reason="no C compiler")
EXAMPLE = Path(__file__).parents[3] / "examples" / "motor"


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    made = tmp_path_factory.mktemp("motor")
    command = [sys.executable, "make.py", str(made), "nothing", "--seconds", "4"]
    subprocess.run(command, cwd=EXAMPLE, check=True, timeout=120)
    here = made / "nothing"
    for fmu in here.glob("*.fmu"):
        trust_program(fmu)
    return here


def simulated(folder: Path) -> np.ndarray:
    return np.loadtxt(folder / "data.csv", delimiter=",", skiprows=1)[:, 3]


def test_linear_equations_become_the_state_space_that_they_are(folder: Path) -> None:
    rec = with_equations(load(folder / "fmu_me.toml"))
    table = rec.twin.parameters
    assert rec.twin.kind == "state_space"
    np.testing.assert_allclose(table["A"], [[0.0, 1.0], [0.0, -12.5]], rtol=1e-12)
    np.testing.assert_allclose(table["B"], [[0.0], [250.0]], rtol=1e-12)
    assert (table["C"], table["D"]) == ([[1.0, 0.0]], [[0.0]])
    assert table["states"] == {"angle": "rad", "speed": "rad/s"}
    twin = make(load(folder / "fmu_me.toml"))
    assert isinstance(twin, OdeTwin)
    assert "speed" in [p.name for p in twin.places]
    assert not_tried(twin) == ""


@pytest.mark.parametrize("kind", ["fmu_me", "fmu_cs", "state_space", "ode"])
def test_every_twin_of_the_motor_simulates_what_its_owner_did(folder: Path, kind: str) -> None:
    """Sixty steps of first order to a sample are its owner's; co-simulation gets the mean of a linear input."""
    angle = free_run(load(folder / f"{kind}.toml"))["angle"]
    assert np.std(angle - simulated(folder)) < 0.005


def rebuilt(folder: Path, out: Path, old: str, new: str) -> Path:
    """A model-exchange FMU of changed C, with its descriptor, in ``out``."""
    source = (EXAMPLE / "motor_fmu.c").read_text()
    assert source.count(old) == 1
    (out / "motor.c").write_text(source.replace(old, new))
    subprocess.run(["cc", "-shared", "-fPIC", "-o", "motor.so", "motor.c", "-lm"], cwd=out, check=True, timeout=60)
    with zipfile.ZipFile(folder / "motor_me.fmu") as was, zipfile.ZipFile(out / "motor_me.fmu", "w") as archive:
        archive.writestr("modelDescription.xml", was.read("modelDescription.xml"))
        archive.write(out / "motor.so", "binaries/linux64/motor.so")
    for name in ("fmu_me.toml", "data.csv"):
        shutil.copy(folder / name, out / name)
    trust_program(out / "motor_me.fmu")
    return out / "fmu_me.toml"


def test_equations_that_are_not_linear_are_refused(folder: Path, tmp_path: Path) -> None:
    rate = "m->v[RATE_ANGLE] = m->v[SPEED];"
    path = rebuilt(folder, tmp_path, rate, f"{rate} m->v[RATE_ANGLE] += 1e-6 * m->v[SPEED] * m->v[SPEED];")
    with pytest.raises(RecordingError, match=r"motor_me.fmu: .* linear.* export this one for co-simulation"):
        make(load(path))


def test_a_linear_map_is_told_from_others() -> None:
    m = np.array([[0.0, 1.0, 0.0], [-3.0, -0.2, 1e6]])

    def linear(x: np.ndarray, u: np.ndarray, t: float) -> np.ndarray:
        return m @ np.concatenate([x, u])

    found = linear_map(linear, np.array([1e-6, 1e3]), 1)
    assert found is not None
    np.testing.assert_allclose(found, m, rtol=1e-12)
    for other in (
        lambda x, u, t: linear(x, u, t) + 1e-3,
        lambda x, u, t: linear(x, u, t) * (1.0 + 1e-6 * t),
        lambda x, u, t: np.clip(linear(x, u, t), -1e7, 1e7),
        lambda x, u, t: linear(x, u, t) + 1e-3 * np.abs(x),
    ):
        assert linear_map(other, np.array([1e-6, 1e3]), 1) is None
