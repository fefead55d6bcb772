"""What inputs do between their samples, and loads that only move one way: integrated here in small steps."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.signal import dlsim, dlti

from sim_devices.physics.exponential import exponential
from tests.unit.mismatch_engine.cases import RATE, recording, wave
from tools.errors import RecordingError
from tools.mismatch.engine.hold import hold_groups, infer_holds, undeclared, with_hold
from tools.mismatch.engine.one_way import direction, one_way
from tools.mismatch.engine.pose import prepared
from tools.mismatch.engine.report import BaseShift
from tools.mismatch.recording import Recording
from tools.mismatch.report import wording
from tools.mismatch.twins.holds import common_hold
from tools.mismatch.twins.linear import between_samples
from tools.mismatch.twins.opaque import opaque_twin

N = 3000


def axis(seed: int, *, zero: bool, late: float = 0.0) -> Recording:
    """A sprung mass under a force that is held or linear between its samples, thirty Euler steps to a sample."""
    rng = np.random.default_rng(seed)
    sub = 30
    force = 3.0 * wave(rng, N, low=1.0, high=60.0)
    at = np.arange(N * sub) / sub - late
    fine = force[np.clip(np.floor(at + 1e-9).astype(int), 0, N - 1)] if zero else np.interp(at, np.arange(N), force)
    h, x, v = 1 / (RATE * sub), 0.0, 0.0
    position = np.empty(N)
    for i in range(N):
        position[i] = x
        for f in fine[i * sub : (i + 1) * sub]:
            v += h * (f - 6.0 * v - 20000.0 * x) / 0.5
            x += h * v
    believed: dict[str, object] = {"mass": 0.5, "damping": 6.0, "stiffness": 20000.0, "offset_force": 0.0}
    measured = position + rng.normal(0, 3e-6, N)
    return recording("mechanical_axis", {"force": force}, {"position": measured}, believed)


@pytest.mark.parametrize("zero", [True, False])
@pytest.mark.parametrize("seed", range(2))
def test_the_hold_of_an_input_is_read_off_the_data(seed: int, zero: bool) -> None:
    problem, _, base = prepared(axis(seed, zero=zero), 0.3, 0, False)
    assert undeclared(problem) == ("force",)
    found = infer_holds(problem, base)["force"]
    assert (found.kind, found.how) == ("zero" if zero else "linear", "inferred")
    assert found.share == pytest.approx(1.0 if zero else 0.0, abs=0.2)


def test_an_input_without_content_above_half_the_rate_is_smooth() -> None:
    """The same stage in exact steps of a thirtieth of a sample, its force between samples by its Fourier series."""
    rng = np.random.default_rng(11)
    sub, period = 30, 1000
    lines = np.zeros(period // 2 + 1, np.complex128)
    lines[5:200] = np.exp(2j * np.pi * rng.random(195))
    force, fine = (np.tile(np.fft.irfft(lines, k * period) * k, 6) for k in (1, sub))
    a = exponential(np.array([[0.0, 1.0], [-40000.0, -12.0]]) / (RATE * sub))
    b = (a[:, 0] - [1.0, 0.0]) / -40000.0
    b = np.array([[b[0]], [b[1]]]) / 0.5
    ahead = dlti(a, b, np.array([[1.0, 0.0]]), np.zeros((1, 1)))
    position = np.asarray(dlsim(ahead, fine[:, None])[1])[::sub, 0]
    believed: dict[str, object] = {"mass": 0.5, "damping": 6.0, "stiffness": 20000.0, "offset_force": 0.0}
    keep = slice(2 * period, None)
    noisy = position + rng.normal(0, 1e-3 * np.std(position), position.size)
    rec = recording("mechanical_axis", {"force": force[keep]}, {"position": noisy[keep]}, believed)
    problem, _, base = prepared(rec, 0.3, 0, False)
    found = infer_holds(problem, base)["force"]
    assert (found.kind, found.how) == ("smooth", "inferred")
    better = prepared(with_hold(rec, {"force": "smooth"}), 0.3, 0, False)[2]
    assert np.std(better.residual["position"]) < 0.9 * np.std(base.residual["position"])


def test_a_smooth_input_meets_sinusoids_between_its_samples() -> None:
    n, turn = 400, 2 * np.pi * 0.35
    at = between_samples(np.sin(turn * np.arange(n)), "smooth")
    # a double integrator sees the spectrum of the lines: their coefficient at this frequency is that of the sinusoid
    lines = at * np.sinc(0.35) ** 2
    assert lines[20:-20] == pytest.approx(np.sin(turn * np.arange(n))[20:-20], abs=1e-3)
    assert between_samples(np.full(50, 3.0), "smooth") == pytest.approx(np.full(50, 3.0))


def test_a_true_delay_of_three_samples_is_no_hold() -> None:
    problem, _, base = prepared(axis(3, zero=False, late=3.0), 0.3, 0, False)
    assert infer_holds(problem, base)["force"].kind == "linear"


def test_a_declared_hold_is_not_questioned() -> None:
    problem, _, base = prepared(with_hold(axis(4, zero=True), {"force": "zero"}), 0.3, 0, False)
    assert undeclared(problem) == ()
    assert infer_holds(problem, base)["force"].how == "declared"
    assert problem.twin.to_text(problem.twin.start(problem.recording))["hold"] == "zero"


@pytest.mark.parametrize("kind", ["state_space", "ode"])
def test_each_input_has_a_hold_of_its_own(kind: str) -> None:
    """A heated body in steps of a fortieth of a sample: its heater is held, the air around it is not."""
    rng = np.random.default_rng(8)
    n, sub, rate, loss = 2000, 40, 40.0, 9.0
    heat, air = (2.0 * wave(rng, n, low=1.0, high=200.0) for _ in range(2))
    at = (np.arange(n * sub) + 0.5) / sub
    power, around = heat[np.floor(at).astype(int)], np.interp(at, np.arange(n), air)
    x, warm = 0.0, np.empty(n)
    for i in range(n):
        warm[i] = x
        for p, a in zip(power[i * sub : (i + 1) * sub], around[i * sub : (i + 1) * sub], strict=True):
            x += (rate * p - loss * (x - a)) / (RATE * sub)
    warm += rng.normal(0, 1e-4, n)
    if kind == "ode":
        believed: dict[str, object] = {"rate": 38.0, "loss": 9.5, "states": {"x": {"unit": "V"}}}
        believed |= {"equations": {"x": "rate * heat - loss * (x - air)"}, "outputs": {"warm": "x"}}
    else:
        believed = {"A": [[-9.5]], "B": [[38.0, 9.5]], "C": [[1.0]]}
    rec = recording(kind, {"heat": heat, "air": air}, {"warm": warm}, believed)
    problem, _, base = prepared(rec, 0.3, 0, False)
    found = infer_holds(problem, base)
    assert {s: (h.kind, h.how) for s, h in found.items()} == {
        "heat": ("zero", "inferred"),
        "air": ("linear", "inferred"),
    }
    right = prepared(with_hold(rec, {"heat": "zero"}), 0.3, 0, False)[2]
    assert np.std(right.residual["warm"]) == pytest.approx(1e-4, rel=0.1)
    assert np.std(base.residual["warm"]) > 2e-4
    problem, _, base = prepared(with_hold(rec, {"air": "linear"}), 0.3, 0, False)
    assert {s: h.how for s, h in infer_holds(problem, base).items()} == {"heat": "inferred", "air": "declared"}


def test_a_program_that_is_told_one_hold_has_one_for_all_inputs() -> None:
    """Equations may hold one input and not the other; an FMU for co-simulation may not."""
    u = wave(np.random.default_rng(3), 500)
    believed: dict[str, object] = {"A": [[-9.5]], "B": [[38.0, 9.5]], "C": [[1.0]]}
    rec = recording("state_space", {"heat": u, "air": u[::-1].copy()}, {"warm": u}, believed)
    problem, _, _ = prepared(rec, 0.3, 0, False)
    assert hold_groups(problem, ("heat", "air")) == [("heat",), ("air",)]
    told = replace(problem, twin=opaque_twin(rec, lambda inputs, parameters: dict(inputs), "made here"))
    assert hold_groups(told, ("heat", "air")) == [("heat", "air")]
    with pytest.raises(RecordingError, match="hold differs between inputs"):
        common_hold(with_hold(rec, {"heat": "zero"}))
    assert common_hold(with_hold(rec, {"heat": "zero", "air": "zero"})) == "zero"


def test_a_hold_of_no_input_is_refused() -> None:
    with pytest.raises(RecordingError, match=r"hold names 'power', which is no input; inputs: force"):
        prepared(with_hold(axis(4, zero=True), {"power": "zero"}), 0.3, 0, False)


def test_which_way_a_load_moved() -> None:
    rng = np.random.default_rng(6)
    t = np.arange(N) / N
    noise = 0.02 * rng.standard_normal(N)
    assert direction(t**2 + noise, 0.02, is_rate=False) == 1
    assert direction(-t + noise, 0.02, is_rate=False) == -1
    assert direction(np.sin(7 * t) + noise, 0.02, is_rate=False) == 0
    assert direction(0.5 + 0.3 * np.sin(9 * t) + noise, 0.02, is_rate=True) == 1
    assert direction(noise, 0.02, is_rate=True) == 0


def test_friction_of_a_load_that_moves_one_way_is_said_to_show_as_an_offset() -> None:
    rng = np.random.default_rng(7)
    sub, friction, mass, damping = 20, 1.2, 2.0, 8.0
    force = 6.0 + 2.0 * wave(rng, N, low=0.3, high=5.0)  # always more than the friction
    h, x, v = 1 / (RATE * sub), 0.0, 0.0
    position = np.empty(N)
    for i in range(N):
        position[i] = x
        for _ in range(sub):
            v = max(v + h * (force[i] - damping * v - friction) / mass, 0.0)
            x += h * v
    believed: dict[str, object] = {"mass": mass, "damping": damping, "stiffness": 0.0, "offset_force": 0.0}
    made = recording("mechanical_axis", {"force": force}, {"position": position + rng.normal(0, 1e-5, N)}, believed)
    problem, raw, base = prepared(made, 0.3, 0, False)
    shifts = [
        BaseShift(p.name, p.unit, float(raw.theta[i]), float(base.theta[i]), float(base.theta[i]), (0.0, 0.0))
        for i, p in enumerate(base.model.parameters)
    ]
    found = one_way(problem, base, shifts)
    assert found is not None
    assert (found.output, found.direction) == ("position", 1)
    assert found.offset is not None
    assert found.offset.value == pytest.approx(-friction, rel=0.1)
    assert found.reversal == pytest.approx(0.1 * float(np.ptp(position)), rel=0.01)
    said = wording.one_way(found)
    assert "friction" in said
    assert "reversal" in said
