"""FMUs for model exchange (built here with the C compiler): linear ones show their equations, others are integrated."""

from __future__ import annotations

import shutil
import subprocess
import sys
import zipfile
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from scipy.integrate import solve_ivp

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


@pytest.mark.parametrize("hold", ["linear", "zero"])
def test_equations_that_are_not_linear_are_integrated(folder: Path, tmp_path: Path, hold: str) -> None:
    """FMPy runs them; the truth is scipy's integrator over the same equations, a sample at a time."""
    pull = "- 40.0 * sin(m->v[ANGLE]) - m->v[SPEED]) /"
    path = rebuilt(folder, tmp_path, "- m->v[SPEED]) /", pull)
    path.write_text(path.read_text().replace("[twin.parameters]", f'[twin.parameters]\nhold = "{hold}"'))
    recording = load(path)
    assert with_equations(recording) is recording
    assert "kind 'ode'" in not_tried(make(recording))
    found = free_run(recording)["angle"]
    u = recording.inputs["command"]
    x, truth = np.zeros(2), [0.0]
    for k in range(300):
        line = (lambda s, k=k: u[k] + (u[k + 1] - u[k]) * s / recording.dt) if hold == "linear" else lambda s, k=k: u[k]

        def rates(s: float, x: np.ndarray, line: Callable[[float], float] = line) -> list[float]:
            return [x[1], (20.0 * line(s) - 40.0 * np.sin(x[0]) - x[1]) / 0.08]

        x = solve_ivp(rates, (0.0, recording.dt), x, rtol=1e-10, atol=1e-12).y[:, -1]
        truth.append(float(x[0]))
    np.testing.assert_allclose(found[:301], truth, atol=1e-5 * np.ptp(truth))


def test_events_are_refused(folder: Path, tmp_path: Path) -> None:
    path = rebuilt(folder, tmp_path, "- m->v[SPEED]) /", "- 0.1 - m->v[SPEED]) /")
    with zipfile.ZipFile(tmp_path / "motor_me.fmu") as was:
        texts = {name: was.read(name) for name in was.namelist()}
    described = texts["modelDescription.xml"].decode()
    texts["modelDescription.xml"] = described.replace('EventIndicators="0"', 'EventIndicators="1"').encode()
    with zipfile.ZipFile(tmp_path / "motor_me.fmu", "w") as archive:
        for name, data in texts.items():
            archive.writestr(name, data)
    trust_program(tmp_path / "motor_me.fmu")
    with pytest.raises(RecordingError, match=r"motor_me.fmu: .* events, .*: export for co-simulation"):
        free_run(load(path))


def test_events_in_time_are_refused(folder: Path, tmp_path: Path) -> None:
    path = rebuilt(
        folder, tmp_path, "memset(e, 0, sizeof *e); return 0;", "memset(e, 0, sizeof *e); e->defined = 1; return 0;"
    )
    with pytest.raises(RecordingError, match=r"motor_me.fmu: .* events in time, .*: export for co-simulation"):
        free_run(load(path))


def test_discrete_states_that_never_settle_are_refused(folder: Path, tmp_path: Path) -> None:
    path = rebuilt(
        folder, tmp_path, "memset(e, 0, sizeof *e); return 0;", "memset(e, 0, sizeof *e); e->discrete = 1; return 0;"
    )
    with pytest.raises(RecordingError, match=r"motor_me.fmu: .*discrete states change still after 100 updates"):
        free_run(load(path))


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
