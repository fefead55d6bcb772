"""Two effects that only together make a recording are found, and a search step stays within its bounds."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
from scipy.optimize import lsq_linear

from sim_devices.physics.catalogue import EFFECTS
from tests.unit.mismatch_model.made import recording
from tools.mismatch.engine.fit import bounded_step, fit, without_unseen
from tools.mismatch.engine.intervals import uncertainty
from tools.mismatch.engine.pose import prepared
from tools.mismatch.engine.vary import added
from tools.mismatch.infer.constants import learned
from tools.mismatch.infer.search import Search
from tools.mismatch.recording import Recording
from tools.mismatch.simulate import Model
from tools.mismatch.simulate_sites import sites
from tools.mismatch.simulate_start import prepare, starts
from tools.mismatch.twins.make import make

N, DT = 1200, 1.0


@pytest.mark.parametrize("seed", range(8))
def test_steps_within_bounds_lead_to_the_minimum_of_a_quadratic(seed: int) -> None:
    """The peer is scipy's bounded least squares. A step that is cut after it is solved does not get there."""
    rng = np.random.default_rng(seed)
    a = rng.normal(size=(30, 5)) @ (np.eye(5) + 3.0 * rng.normal(size=(5, 5)))
    b = rng.normal(size=30) * 10.0
    lo, hi = -rng.uniform(0.01, 0.3, 5), rng.uniform(0.01, 0.3, 5)
    x = np.zeros(5)
    for _ in range(60):
        x = x + bounded_step(a.T @ a, a.T @ (a @ x - b), 1e-8, lo - x, hi - x)
        assert np.all((lo <= x) & (x <= hi))
    best = lsq_linear(a, b, (lo, hi)).cost
    assert 0.5 * float(np.sum((a @ x - b) ** 2)) == pytest.approx(best, rel=0.02)


def tanks(seed: int) -> Recording:
    """Torricelli outflow of both tanks and an overflow into the lower one, by small Euler steps; the twin is linear."""
    rng = np.random.default_rng(seed)
    pump = np.repeat(rng.uniform(0.8, 5.2, N // 30), 30)
    upper, lower, steps = 3.0, 3.0, 20
    level = np.empty(N)
    for i in range(N):
        level[i] = lower
        for _ in range(steps):
            out, down = 0.17 * np.sqrt(max(upper, 0.0)), 0.17 * np.sqrt(max(lower, 0.0))
            spill, lost = 0.4 * max(upper - 7.0, 0.0), 0.5 * max(lower - 7.5, 0.0)
            upper += DT / steps * (0.11 * pump[i] - out - spill)
            lower += DT / steps * (out + 0.6 * spill - down - lost)
    level += 0.02 * rng.standard_normal(N)
    twin = {
        "states": {"upper": {"unit": "V", "start": 3.0}, "lower": {"unit": "V", "start": 3.0}},
        "equations": {"upper": "gain * pump - a * upper - c", "lower": "a * upper - b * lower"},
        "outputs": {"level": "lower"},
        "hold": "zero", "gain": 0.11, "a": 0.045, "b": 0.045, "c": 0.1,
    }  # fmt: skip
    return recording("ode", DT, {"pump": pump}, {"level": level}, {"pump": "V", "level": "V"}, twin)


@pytest.mark.slow
def test_a_pair_of_which_each_member_gains_little_alone_is_found() -> None:
    rec = tanks(3)
    names = ("overflow", "square_root_outflow", "dead_time", "first_order_lag", "backlash")
    problem, _, base = prepared(rec, 0.3, 0, was_joined=False)
    search = Search(problem, base, [EFFECTS[n] for n in names], learned(), moves=3)
    with np.errstate(all="ignore"):
        search.expand(search.store.base)
        alone = max(search.gain_before_prices(s) for s in search.store.sets.values() if len(s.placed) == 1)
        search.pair()
    best = search.store.ranked()[0]
    assert best.names == {"overflow", "square_root_outflow"}
    assert search.gain_before_prices(best) > 1.5 * alone


def cylinder(seed: int) -> Recording:
    """A hydraulic cylinder in a position loop, by small Euler steps: its valve overlaps, and it goes out faster."""
    rng = np.random.default_rng(seed)
    n, dt, steps = 2000, 0.01, 20
    wanted = np.repeat(rng.uniform(-60.0, 60.0, n // 80), 80)
    valve, stroke = np.empty(n), np.empty(n)
    opening = x = 0.0
    for k in range(n):
        stroke[k] = x + 0.05 * rng.standard_normal()
        valve[k] = np.clip(0.12 * (wanted[k] - stroke[k]), -8.0, 8.0)
        open_to = valve[k] - np.clip(valve[k], -0.4, 0.4)
        for _ in range(steps):
            opening += dt / steps * (open_to - opening) / 0.03
            x += dt / steps * 21.0 * (1.13 if opening > 0.0 else 0.87) * opening
    twin = {
        "states": {"opening": "V", "stroke": "mm"},
        "equations": {"opening": "(valve - opening) / lag", "stroke": "gain * opening"},
        "lag": 0.032, "gain": 20.0, "hold": "zero",
    }  # fmt: skip
    return recording("ode", dt, {"valve": valve}, {"stroke": stroke}, {"valve": "V", "stroke": "mm"}, twin)


@pytest.mark.slow
def test_a_pair_is_found_behind_one_effect_that_imitates_both() -> None:
    """Friction with two levels leaves a thirtieth, and every set that grows from it keeps it."""
    problem, _, base = prepared(cylinder(5), 0.3, 0, was_joined=False)
    effects = [EFFECTS[n] for n in ("coulomb_friction", "dead_zone", "direction_dependence")]
    search = Search(problem, base, effects, learned())
    with np.errstate(all="ignore"):
        search.expand(search.store.base)
        assert search.store.ranked()[0].names == {"coulomb_friction"}
        search.run()
    best = search.store.ranked()[0]
    assert {(p.effect.name, p.target) for p in best.placed} == {
        ("dead_zone", "valve"),
        ("direction_dependence", "gain by direction of stroke"),
    }


def folded(power: float, seed: int) -> Recording:
    """A reader of the magnitude behind a damped oscillator, which is integrated by small steps."""
    rng = np.random.default_rng(seed)
    u = np.repeat(rng.uniform(-2.0, 2.0, 40), 25)
    x = v = 0.0
    y = np.empty(u.size)
    for i in range(u.size):
        y[i] = 0.6 * abs(x) ** power
        for _ in range(50):
            v += 0.02 / 50 * (144.0 * (u[i] - x) - 5.0 * v)
            x += 0.02 / 50 * v
    y += 0.005 * rng.standard_normal(u.size)
    twin = {"A": [[0.0, 1.0], [-140.0, -6.0]], "B": [[0.0], [140.0]], "C": [[1.0, 0.0]]}
    twin |= {"x0": [0.0, 0.0], "hold": "zero"}
    return recording("state_space", 0.02, {"drive": u}, {"speed": y}, {"drive": "V", "speed": "V"}, twin)


@pytest.mark.parametrize("power", [1.0, 1.7, 2.0])
def test_a_sensor_that_reads_a_power_of_the_magnitude(power: float) -> None:
    rec = folded(power, 5)
    problem, _, base = prepared(rec, 0.3, 0, was_joined=False)
    fold = replace(EFFECTS["static_nonlinearity"].variants[0], variants=())
    (place,) = sites(make(rec), rec, fold)
    placed = prepare(base.model, problem.fit_view, base.theta, place)
    model = Model(problem.twin, (placed,))
    theta = model.carry(base.model, base.theta, rec)
    found = fit(problem, model, starts(model, 0, problem.fit_view, theta))
    figures = {h.name: h.value for h in found.model.human(found.theta)[placed.label]}
    assert figures["power"] == pytest.approx(power, abs=0.05)
    assert float(np.std(found.residual["speed"][problem.held_rows])) < 0.01
    # the scale of the signal is determined: every figure of the base is
    assert np.all(np.isfinite(uncertainty(problem, found).deviations()))


def creeping_axis(tau_s: float, newton: float) -> Recording:
    """An axis whose drive adds an offset that settles, integrated by small steps of its own."""
    rng = np.random.default_rng(11)
    n, dt = 3000, 0.01
    force = np.repeat(rng.uniform(-8.0, 8.0, n // 50), 50)
    x = v = 0.0
    y = np.empty(n)
    for i in range(n):
        y[i] = x
        for k in range(20):
            now = (i + k / 20) * dt
            v += dt / 20 * (force[i] + newton * math.exp(-now / tau_s) - 6.0 * v - 120.0 * x) / 2.0
            x += dt / 20 * v
    y += 2e-4 * rng.standard_normal(n)
    twin = {"mass": 2.0, "damping": 6.0, "stiffness": 120.0, "hold": "zero"}
    return recording("mechanical_axis", dt, {"force": force}, {"position": y}, {"force": "N", "position": "m"}, twin)


def test_the_offset_of_a_drive_that_settles() -> None:
    rec = creeping_axis(9.0, 1.5)
    problem, _, base = prepared(rec, 0.3, 0, was_joined=False)
    every = sites(make(rec), rec, EFFECTS["thermal_drift"])
    (place,) = [p for p in every if p.site == "input"]
    with np.errstate(all="ignore"):
        found = added(problem, base, place)
    figures = {h.name: (h.value, h.unit) for h in found.model.human(found.theta)[place.label]}
    assert figures["time_constant_s"][0] == pytest.approx(9.0, rel=0.05)
    assert figures["slow_amplitude"] == (pytest.approx(-1.5, rel=0.05), "{in}")
    assert float(np.std(found.residual["position"][problem.held_rows])) < 2.5e-4


def test_what_moves_nothing_stays_where_it_is() -> None:
    """Friction whose level is zero has an asymmetry without effect: by the rounding of its slope it ran to 1e136."""
    j = np.array([[1.0, 1e-70], [2.0, -3e-70]])
    residual = np.array([0.5, -1.0])
    gradient, hessian = without_unseen(j.T @ residual, j.T @ j, np.ones(2), float(residual @ residual))
    wide = np.full(2, np.inf)
    step = bounded_step(hessian, gradient, 1e-8, -wide, wide)
    assert step[1] == 0.0
    assert step[0] == pytest.approx(0.3)
    assert abs(bounded_step(j.T @ j, j.T @ residual, 1e-8, -wide, wide)[1]) > 1e50
