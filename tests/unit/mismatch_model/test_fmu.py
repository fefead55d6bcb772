"""A real FMU (built here from Python) as a twin, against the closed form; needs FMPy and PythonFMU."""

from __future__ import annotations

import pickle
import zipfile
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from hal.trust import NotTrusted, digest_of, trust_program
from tests.unit.mismatch_model.made import recording
from tools.errors import RecordingError
from tools.guest.fmu import OpenFmu, over_the_step
from tools.mismatch.recording import Recording
from tools.mismatch.simulate import Model
from tools.mismatch.simulate_view import View
from tools.mismatch.twins.make import make

pytest.importorskip("fmpy", reason="the extra 'fmu' is not installed")

HEATED = """
import math
from pythonfmu import Fmi2Causality, Fmi2Slave, Fmi2Variability, Real

class Heated(Fmi2Slave):
    def __init__(self, **kwargs):
        super().__init__(**kwargs)
        self.power = self.position = self.warm = 0.0
        self.um_per_W, self.time_constant_s = 2.0, 0.5
        self.register_variable(Real("power", causality=Fmi2Causality.input))
        self.register_variable(Real("position", causality=Fmi2Causality.output))
        for name in ("um_per_W", "time_constant_s"):
            self.register_variable(Real(name, causality=Fmi2Causality.parameter, variability=Fmi2Variability.tunable))

    def do_step(self, current_time, step_size):
        decay = math.exp(-step_size / self.time_constant_s)
        self.warm = decay * self.warm + (1 - decay) * self.power
        self.position = self.um_per_W * self.warm
        return True
"""
N, DT = 300, 0.02
POWER = 1 + np.sin(2 * np.pi * 0.7 * np.arange(N) * DT)


@pytest.fixture(scope="module")
def fmu(tmp_path_factory: pytest.TempPathFactory) -> Path:
    builder = pytest.importorskip("pythonfmu.builder", reason="PythonFMU is not installed")
    folder = tmp_path_factory.mktemp("fmu")
    (folder / "heated.py").write_text(HEATED)
    built = Path(builder.FmuBuilder.build_FMU(folder / "heated.py", dest=folder))
    trust_program(built)
    return built


def of(path: Path, **more: object) -> Recording:
    given = {"path": str(path), "um_per_W": 2.0, "time_constant_s": 0.5, **more}
    made = recording("fmu", DT, {"power": POWER}, {"position": 2.0 * POWER}, {}, given)
    return replace(made, path=path.parent / "made.toml")


def truth(gain: float, tau: float, over_the_step: np.ndarray = POWER) -> np.ndarray:
    a, y = np.exp(-DT / tau), np.zeros(N)
    for k in range(N - 1):
        y[k + 1] = a * y[k] + (1 - a) * gain * over_the_step[k]
    return y


def test_linear_inputs_are_held_over_half_steps_with_their_mean_and_first_moment(fmu: Path) -> None:
    """They are assumed where nothing is declared; ``hold = "zero"`` gives each step its first sample."""
    rec = of(fmu)
    got = Model(make(rec)).simulate(View.whole(rec), np.array([2.0, 0.5]))["position"]
    first, second = over_the_step(POWER, 2)
    a, warm = np.exp(-DT / 2 / 0.5), np.zeros(N)
    for k in range(N - 1):
        half = a * warm[k] + (1 - a) * first[k]
        warm[k + 1] = a * half + (1 - a) * second[k]
    np.testing.assert_allclose(got, 2.0 * warm, atol=1e-12)
    assert set(make(rec).holds.values()) == {"linear"}  # type: ignore[attr-defined]
    with pytest.raises(RecordingError, match="hold must be 'zero' or 'linear'"):
        make(of(fmu, hold="smooth"))


def test_both_integrals_of_what_is_held_are_those_of_the_line() -> None:
    a, b = POWER[:-1], POWER[1:]
    first, second = over_the_step(POWER, 2)[:, :-1]
    np.testing.assert_allclose((first + second) / 2, (a + b) / 2, rtol=1e-14)  # over the step
    # integral of the line times the time that is left: a double integrator's position
    np.testing.assert_allclose(first * 3 / 8 + second / 8, a / 3 + b / 6, rtol=1e-14)
    np.testing.assert_allclose(over_the_step(POWER)[0, :-1], (a + b) / 2, rtol=1e-14)


def test_an_fmu_that_refuses_half_steps_gets_the_mean_over_whole_ones(fmu: Path) -> None:
    run = OpenFmu(fmu, digest_of(fmu.read_bytes()), ("position",), DT)
    step = run.instance.fmi2DoStep

    def stubborn(component: object, t: float, h: float, keep: int) -> object:
        if h < 0.9 * DT:
            raise ValueError("step size")
        return step(component, t, h, keep)

    run.instance.fmi2DoStep = stubborn
    inputs = {"power": POWER, "t": np.arange(N) * DT}
    start = {"um_per_W": 2.0, "time_constant_s": 0.5, "hold": "linear"}
    for _ in range(2):
        got = run(inputs, start)["position"]
        np.testing.assert_allclose(got, truth(2.0, 0.5, 0.5 * (POWER + np.roll(POWER, -1))), atol=1e-12)
    assert run.parts == 1


def test_runs_with_its_parameters_and_from_its_own_start(fmu: Path) -> None:
    rec = of(fmu, hold="zero")
    model = Model(make(rec))
    assert [p.name for p in model.parameters] == ["um_per_W", "time_constant_s"]
    for gain, tau in ((2.0, 0.5), (3.0, 0.5), (2.0, 0.1), (2.0, 0.5)):
        got = model.simulate(View.whole(rec), np.array([gain, tau]))["position"]
        np.testing.assert_allclose(got, truth(gain, tau), atol=1e-12)


def test_goes_to_another_process(fmu: Path) -> None:
    rec = of(fmu)
    twin = make(rec)
    first = Model(twin).simulate(View.whole(rec), np.array([2.0, 0.5]))["position"]
    there = Model(pickle.loads(pickle.dumps(twin)))
    np.testing.assert_array_equal(there.simulate(View.whole(rec), np.array([2.0, 0.5]))["position"], first)


def test_what_is_no_fmu_or_lacks_a_variable_is_said(fmu: Path, tmp_path: Path) -> None:
    with pytest.raises(RecordingError, match="no variable heat in the FMU"):
        make(of(fmu, heat=1.0))
    (tmp_path / "text.fmu").write_text("no zip")
    with pytest.raises(RecordingError, match="cannot be opened as an FMU"):
        make(of(tmp_path / "text.fmu"))
    with zipfile.ZipFile(tmp_path / "empty.fmu", "w") as z:
        z.writestr("readme.txt", "nothing")
    with pytest.raises(NotTrusted, match=r"names the program .*empty.fmu"):
        make(of(tmp_path / "empty.fmu"))
    trust_program(tmp_path / "empty.fmu")
    with pytest.raises(RecordingError, match="cannot be opened as an FMU"):
        make(of(tmp_path / "empty.fmu"))


def test_stepping_it_ourselves_is_what_fmpy_does(fmu: Path) -> None:
    run = OpenFmu(fmu, digest_of(fmu.read_bytes()), ("position",), DT)
    inputs, start = {"power": POWER, "t": np.arange(N) * DT}, {"um_per_W": 3.0, "time_constant_s": 0.2}
    mine = run(inputs, start)["position"]
    run.instance.reset()
    np.testing.assert_allclose(mine, run.simulated(inputs, start)["position"], rtol=0.0, atol=1e-12)
    mine = run(inputs, {**start, "hold": "linear"})["position"]
    run.instance.reset()
    theirs = run.simulated(inputs, start, "linear", 2)["position"]
    np.testing.assert_allclose(mine, theirs, rtol=0.0, atol=1e-12)


def test_values_that_the_fmu_cannot_take_end_no_search_but_the_engineers_own_do(fmu: Path) -> None:
    """exp(-dt / tau) of a negative time constant overflows: a search must be able to try it and turn round."""
    rec = of(fmu)
    tried = Model(make(rec)).simulate(View.whole(rec), np.array([2.0, -1e-5]))["position"]
    assert np.all(np.isnan(tried))
    given = of(fmu, time_constant_s=-1e-5)
    with pytest.raises(RecordingError, match=r"the FMU stopped|is (nan|inf)"):
        Model(make(given)).simulate(View.whole(given), np.array([2.0, -1e-5]))
