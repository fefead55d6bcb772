"""Forces are started from the balance of the equation of motion along a recording, without a run.

The courses are closed forms: a position of three sines has exact derivatives, and the drive is what the equation of
motion asks for. So the balance must give back every number of it.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from sim_devices.physics.catalogue import EFFECTS
from tests.unit.mismatch_engine.cases import recording
from tools.mismatch.engine.fit import Fit, as_given
from tools.mismatch.engine.pose import prepared
from tools.mismatch.engine.problem import Problem
from tools.mismatch.engine.screen import places
from tools.mismatch.recording import Recording, TwinText
from tools.mismatch.simulate import Model
from tools.mismatch.simulate_balance import balanced, bump, noise_of
from tools.mismatch.simulate_joint import in_balance
from tools.mismatch.simulate_start import prepare, probe_signals
from tools.mismatch.simulate_view import View, view_run
from tools.mismatch.twins.base import Balance, central_difference, midway
from tools.mismatch.twins.dynamic import DynamicTwin
from tools.mismatch.twins.make import make
from tools.mismatch.twins.ode import OdeTwin

RATE_HZ, N = 500.0, 6000
MASS, DAMPING, PERIOD, COG = 2.0, 8.0, 0.4, 1.5
T = np.arange(N) / RATE_HZ
SINES = ((0.9, 1.3), (0.5, 3.1), (0.2, 7.7))  # metres, rad/s


def moved(of: int) -> np.ndarray:
    """Position, velocity or acceleration."""
    turn = (np.sin, np.cos, lambda a: -np.sin(a))[of]
    return np.sum([a * w**of * turn(w * T) for a, w in SINES], axis=0)


def axis(noise_m: float, believed: dict[str, float], outputs: tuple[str, ...] = ("position",)) -> Recording:
    x, v, a = (moved(k) for k in range(3))
    force = MASS * a + DAMPING * v - COG * np.sin(2 * np.pi * x / PERIOD) + 0.3
    rng = np.random.default_rng(3)
    noisy = {"position": x, "velocity": v}
    measured = {o: noisy[o] + noise_m * rng.standard_normal(N) for o in outputs}
    units = {"hold": "linear", **believed}
    return recording("mechanical_axis", {"force": force}, measured, units, rate_hz=RATE_HZ)


def started(rec: Recording, effect: str) -> tuple[Model, list[np.ndarray]]:
    problem, _, _ = prepared(rec, 0.3, 0, False)
    given = as_given(problem)
    (place,) = [p for p in places(problem, [EFFECTS[effect]], ()) if p.site == "feedback"][:1]
    placed = prepare(given.model, problem.fit_view, given.theta, place)
    model = Model(problem.twin, (placed,))
    theta = model.carry(given.model, given.theta, problem.recording)
    x, ctx = probe_signals(given.model, problem.fit_view, given.theta, placed, "position")
    return model, balanced(model, 0, problem.fit_view, theta, x, ctx)


@pytest.mark.parametrize("noise_m", [0.0, 1e-3])
def test_the_balance_gives_back_cogging_and_the_base_that_is_a_quarter_off(noise_m: float) -> None:
    model, starts = started(axis(noise_m, {"mass": 2.5, "damping": 6.0, "offset_force": 0.0}), "cogging")
    got = dict(zip([p.name.rsplit(".", 1)[-1] for p in model.parameters], starts[0], strict=True))
    assert got["period"] == pytest.approx(PERIOD, rel=0.01)
    assert got["damping_per_mass"] == pytest.approx(DAMPING / MASS, rel=0.02)
    assert got["inverse_mass"] == pytest.approx(1 / MASS, rel=0.02)
    assert got["offset_per_mass"] == pytest.approx(-0.3 / MASS, abs=0.01)
    assert np.hypot(got["sin1"], got["cos1"]) == pytest.approx(COG / MASS, rel=0.03)


def equations(believed: dict[str, float]) -> dict[str, object]:
    return {
        "states": {"position": {"unit": "m"}, "speed": {"unit": "m/s"}},
        "equations": {"position": "speed", "speed": "(force + load - damping * speed) / mass"},
        "hold": "linear",
        **believed,
    }


def test_equations_balance_as_the_axis_does_and_not_where_a_state_was_not_recorded() -> None:
    believed = {"mass": 2.5, "damping": 6.0, "load": 0.0}
    rec = axis(1e-3, believed)
    model, starts = started(replace(rec, twin=TwinText("ode", equations(believed))), "cogging")
    got = dict(zip([p.name.rsplit(".", 1)[-1] for p in model.parameters], starts[0], strict=True))
    assert got["period"] == pytest.approx(PERIOD, rel=0.01)
    # only ratios are in the balance: one step of least squares moves all three
    assert got["damping"] / got["mass"] == pytest.approx(DAMPING / MASS, rel=0.1)
    hidden = equations(believed)
    hidden["states"] = {**hidden["states"], "lagged": {"unit": "N"}}  # type: ignore[dict-item]
    hidden["equations"] = {
        "position": "speed",
        "speed": "(lagged + load - damping * speed) / mass",
        "lagged": "(force - lagged) / 0.01",
    }
    assert started(replace(rec, twin=TwinText("ode", hidden)), "cogging")[1] == []


def test_a_zero_of_the_sensor_does_not_hide_the_state() -> None:
    """The position is read with a zero that was re-fitted; the balance is that of the readings less this zero."""
    rec = axis(0.0, {"mass": 2.0, "damping": 8.0})
    rec = replace(rec, twin=TwinText("ode", equations({"mass": 2.0, "damping": 8.0, "load": 0.0})))
    moved_by = replace(rec, outputs={"position": rec.outputs["position"] + 0.2})
    balances: list[Balance] = []
    for one, zero in ((rec, 0.0), (moved_by, 0.2)):
        twin = make(one)
        assert isinstance(twin, OdeTwin)
        theta = twin.start(one)
        theta[[p.name for p in twin.parameters].index("position_offset")] = zero
        found = twin.balance(view_run(twin, View.whole(one)), theta, "speed")
        assert found is not None
        balances.append(found)
    assert balances[1].reading == pytest.approx(balances[0].reading, abs=1e-9)
    assert balances[1].model == pytest.approx(balances[0].model, abs=1e-6)


def cogging_and_friction() -> tuple[Problem, Fit, Model, np.ndarray]:
    """The axis with dry friction of 2 N beside its cogging; theta has three times the cogging and no friction."""
    rec = axis(0.0, {"mass": 2.5, "damping": 6.0, "offset_force": 0.0})
    force = rec.inputs["force"] + 2.0 * np.sign(moved(1))
    problem, _, _ = prepared(replace(rec, inputs={"force": force}), 0.3, 0, False)
    given = as_given(problem)
    cogging, friction = (
        prepare(given.model, problem.fit_view, given.theta, next(p for p in found if p.site == "feedback"))
        for found in (places(problem, [EFFECTS[name]], ()) for name in ("cogging", "coulomb_friction"))
    )
    model = Model(problem.twin, (cogging, friction))
    theta = model.carry(given.model, given.theta, problem.recording)
    names = [p.name.rsplit(".", 1)[-1] for p in model.parameters]
    theta[names.index("period")], theta[names.index("sin1")] = PERIOD, 3.0 * COG / MASS
    return problem, given, model, theta


def test_a_force_that_was_fitted_for_two_is_put_right_beside_the_second() -> None:
    problem, given, model, theta = cogging_and_friction()
    x, ctx = probe_signals(given.model, problem.fit_view, given.theta, model.placed[1], "position")
    names = [p.name.rsplit(".", 1)[-1] for p in model.parameters]
    got = dict(zip(names, balanced(model, 1, problem.fit_view, theta, x, ctx)[0], strict=True))
    assert got["level"] == pytest.approx(2.0 / MASS, rel=0.05)
    assert got["sin1"] == pytest.approx(COG / MASS, rel=0.05)


def test_two_forces_and_the_base_are_fitted_to_the_balance_at_once() -> None:
    """Periods are searched, too: this one begins a thirtieth off."""
    problem, _, model, theta = cogging_and_friction()
    names = [p.name.rsplit(".", 1)[-1] for p in model.parameters]
    theta[names.index("period")] *= 1.03
    found = in_balance(model, problem.fit_view, theta)
    assert found is not None
    got = dict(zip(names, found, strict=True))
    assert got["period"] == pytest.approx(PERIOD, rel=1e-3)
    assert got["level"] == pytest.approx(2.0 / MASS, rel=0.02)
    assert np.hypot(got["sin1"], got["cos1"]) == pytest.approx(COG / MASS, rel=0.02)
    assert got["inverse_mass"] == pytest.approx(1 / MASS, rel=0.01)
    assert got["damping_per_mass"] == pytest.approx(DAMPING / MASS, rel=0.02)


def test_a_limit_of_the_drive_and_a_force_behind_it_are_fitted_at_once() -> None:
    """The balance sees the input behind its own effect; the recording is simulated by small steps."""
    rng, steps = np.random.default_rng(4), 20
    command = 30.0 * np.repeat(rng.uniform(-1.0, 1.0, N // 100), 100)
    read, x, v = np.empty(N), 0.0, 0.0
    for i in range(N):
        read[i] = x
        for _ in range(steps):
            a = (np.clip(command[i], -18.0, 18.0) - DAMPING * v + 4.0 * np.sin(2 * np.pi * x / PERIOD)) / MASS
            v += a / (RATE_HZ * steps)
            x += v / (RATE_HZ * steps)
    text = equations({"mass": 2.2, "damping": 7.0, "load": 0.0}) | {"hold": "zero"}
    rec = recording("ode", {"force": command}, {"position": read}, text, rate_hz=RATE_HZ)
    problem, _, _ = prepared(rec, 0.3, 0, False)
    given = as_given(problem)
    limit, cogging = (
        prepare(given.model, problem.fit_view, given.theta, next(p for p in found if p.site == site))
        for site, found in (
            (site, places(problem, [EFFECTS[name]], ()))
            for site, name in (("input", "saturation"), ("feedback", "cogging"))
        )
    )
    model = Model(problem.twin, (limit, cogging))
    theta = model.carry(given.model, given.theta, problem.recording)
    names = [p.name.rsplit(".", 1)[-1] for p in model.parameters]
    for name, value in {"lower_limit": -14.0, "upper_limit": 15.0, "corner": 4.0, "period": 1.01 * PERIOD}.items():
        theta[names.index(name)] = value
    found = in_balance(model, problem.fit_view, theta)
    assert found is not None
    got = dict(zip(names, found, strict=True))
    assert (got["lower_limit"] / got["mass"], got["upper_limit"] / got["mass"]) == pytest.approx((-9, 9), rel=0.02)
    assert np.hypot(got["sin1"], got["cos1"]) == pytest.approx(4.0 / MASS, rel=0.03)


def test_a_state_that_was_not_recorded_has_no_balance() -> None:
    hidden = equations({"mass": 2.0, "damping": 8.0, "load": 0.0})
    hidden["states"] = {**hidden["states"], "lagged": {"unit": "N"}}  # type: ignore[dict-item]
    hidden["equations"] = {
        "position": "speed",
        "speed": "(lagged + load - damping * speed) / mass",
        "lagged": "(force - lagged) / 0.01",
    }
    rec = replace(axis(1e-3, {"mass": 2.0, "damping": 8.0}), twin=TwinText("ode", hidden))
    problem, _, _ = prepared(rec, 0.3, 0, False)
    place = next(p for p in places(problem, [EFFECTS["coulomb_friction"]], ()) if p.site == "feedback")
    given = as_given(problem)
    model = Model(problem.twin, (prepare(given.model, problem.fit_view, given.theta, place),))
    assert in_balance(model, problem.fit_view, model.start(rec)) is None


def test_equations_that_diverge_on_the_way_give_no_start(monkeypatch: pytest.MonkeyPatch) -> None:
    rec = axis(1e-3, {"mass": 2.5, "damping": 6.0})
    whole = DynamicTwin.balance
    calls: list[int] = []

    def balance(self: DynamicTwin, *of: Any) -> Balance | None:
        calls.append(1)
        return whole(self, *of) if len(calls) == 1 else None

    monkeypatch.setattr(DynamicTwin, "balance", balance)
    assert started(rec, "cogging")[1] == []


def test_only_noise_gives_no_start() -> None:
    """Under no bump is the acceleration of such readings calm."""
    assert started(axis(0.5, {"mass": 2.5, "damping": 6.0}), "cogging")[1] == []


def test_a_bump_has_the_sum_one_and_noise_is_read_off_beside_a_smooth_course() -> None:
    assert np.sum(bump(7)) == pytest.approx(1.0)
    assert bump(7)[0] < 1e-2 * bump(7)[7]
    readings = moved(0) + 0.01 * np.random.default_rng(1).standard_normal(N)
    assert noise_of(readings) == pytest.approx(0.01, rel=0.05)


def test_differences_are_those_of_a_parabola_and_a_held_input_lies_half_a_sample_late() -> None:
    x = 0.5 * 3.0 * T**2
    assert central_difference(x, 1 / RATE_HZ, 2) == pytest.approx(np.full(N, 3.0), rel=1e-6)
    assert central_difference(x, 1 / RATE_HZ, 1)[1:-1] == pytest.approx(3.0 * T[1:-1], rel=1e-9)
    assert midway(np.array([1.0, 3.0, 5.0]), True).tolist() == [1.0, 2.0, 4.0]
    assert midway(np.array([1.0, 3.0]), False).tolist() == [1.0, 3.0]
