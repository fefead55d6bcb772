"""Beside a twin of many modes an effect is searched alone, while the base moves along its sensitivities."""

from __future__ import annotations

import numpy as np
import pytest

from sim_devices.physics.catalogue import EFFECTS
from tests.unit.mismatch_engine.cases import recording
from tools.mismatch.engine.fit import Fit, as_given, fit
from tools.mismatch.engine.linearised import Beside, fit_beside
from tools.mismatch.engine.noise import noise_floor
from tools.mismatch.engine.pose import make_split
from tools.mismatch.engine.problem import Problem
from tools.mismatch.engine.screen import ROWS, Candidate, Ground, bend, is_wide, one_step, places
from tools.mismatch.placed import Placed
from tools.mismatch.recording import Recording
from tools.mismatch.simulate import Model
from tools.mismatch.simulate_view import View
from tools.mismatch.twins.make import make

Array = np.ndarray
ORDER, N, RATE_HZ = 16, 4000, 200.0
NOISE = 0.002
PLAY = 0.5
"""Half width of the play, in standard deviations of the sensor's signal."""


def modal() -> tuple[Array, Array, Array]:
    rng = np.random.default_rng(4)
    w = np.exp(np.linspace(np.log(8.0), np.log(200.0), ORDER // 2))
    a = np.zeros((ORDER, ORDER))
    for i, v in enumerate(w):
        a[2 * i : 2 * i + 2, 2 * i : 2 * i + 2] = [[0.0, v], [-v, -0.06 * v]]
    b, c = np.zeros((ORDER, 1)), rng.standard_normal((2, ORDER))
    b[1::2, 0] = w
    return a, b, c


def played(x: Array, half: float) -> Array:
    """A sensor whose play is at its end: it follows when the signal has moved by ``half`` to either side."""
    y = np.empty_like(x)
    y[0] = x[0]
    for k in range(1, x.size):
        y[k] = min(max(y[k - 1], x[k] - half), x[k] + half)
    return y


def made() -> Recording:
    a, b, c = modal()
    rng = np.random.default_rng(5)
    u = np.convolve(rng.standard_normal(N), np.ones(4) / 4, "same")
    matrices = {"A": a.tolist(), "B": b.tolist(), "C": c.tolist()}
    blank = recording("state_space", {"u": u}, {"y0": np.cos(u), "y1": np.cos(u)}, matrices, rate_hz=RATE_HZ)
    model = Model(make(blank))
    clean = model.simulate(View.whole(blank), model.start(blank))
    sensed = {"y0": clean["y0"], "y1": played(clean["y1"], PLAY * float(np.std(clean["y1"])))}
    y = {o: x + NOISE * float(np.std(x)) * rng.standard_normal(N) for o, x in sensed.items()}
    given = {**matrices, "A": (1.02 * a).tolist()}
    return recording("state_space", {"u": u}, y, given, rate_hz=RATE_HZ)


@pytest.fixture(scope="module")
def posed() -> tuple[Problem, Fit, Ground]:
    rec = made()
    twin = make(rec)
    problem = Problem(rec, twin, make_split(rec, 0.3, 0, False), 0, 0, settle=True)
    given = as_given(problem)
    problem = problem.with_floors({o: noise_floor(r, r, RATE_HZ, declared=NOISE) for o, r in given.residual.items()})
    base = fit(problem, given.model, [given.theta], iterations=8, rounds=1)
    return problem, base, bend(problem, base)


def place(problem: Problem, name: str, output: str) -> Placed:
    return next(p for p in places(problem, [EFFECTS[name]], ()) if p.target == output)


def candidate(posed: tuple[Problem, Fit, Ground], name: str, output: str) -> tuple[Model, Candidate]:
    problem, base, ground = posed
    found = one_step(problem, base, place(problem, name, output), ground)
    return Model(problem.twin, (found.placed,)), found


def test_responses_at_some_samples_are_those_of_the_whole(posed: tuple[Problem, Fit, Ground]) -> None:
    problem, base, ground = posed
    some = base.model.design(problem.view, base.theta, samples=ground.samples)
    every = base.model.design(problem.view, base.theta)
    for o in problem.twin.outputs:
        assert some.linear[o] == every.linear[o]
        size = np.abs(every.columns[o]).max()
        np.testing.assert_allclose(some.columns[o], every.columns[o][ground.rows], rtol=0, atol=1e-9 * size)
        np.testing.assert_allclose(some.constant[o], every.constant[o][ground.rows], rtol=0, atol=1e-9 * size)


def test_a_base_that_moves_linearly_leaves_what_a_small_move_of_it_makes(posed: tuple[Problem, Fit, Ground]) -> None:
    problem, base, ground = posed
    assert is_wide(problem, base.model)
    model, found = candidate(posed, "backlash", "y1")
    beside = Beside(problem, model, base, ground, ROWS)
    theta = found.starts[0].copy()
    theta[: model.n_base] = base.theta
    theta[model.slices(0)[1]] = 0.0
    here, _ = beside.evaluate(theta)
    other = theta.copy()
    other[0] *= 1.0 + 1e-5
    moved, _ = beside.evaluate(other)
    alone = base.model.simulate(problem.view, np.r_[other[0], base.theta[1:]])
    change = np.concatenate(
        [(alone[o] - problem.measured[o] + base.residual[o])[beside.rows] * beside.weight[o] for o in beside.outputs]
    )
    # the solved base takes the move of a base parameter back, but for the curvature in a forward difference
    assert np.linalg.norm(moved - here) < 0.15 * np.linalg.norm(change)


def test_the_play_of_a_sensor_is_found_beside_many_modes(posed: tuple[Problem, Fit, Ground]) -> None:
    problem, base, ground = posed
    model, found = candidate(posed, "backlash", "y1")
    fitted = fit_beside(problem, model, base, ground, found.starts, hopeless=np.inf)
    rows = problem.held_rows
    before, after = (float(np.std(f.residual["y1"][rows])) for f in (base, fitted))
    assert fitted.ok
    assert after < 0.3 * before
    # each column of a Jacobian would be an evaluation
    assert len(model.nonlinear) > 30
    assert fitted.evaluations < 120


def test_a_hopeless_effect_is_not_refined(posed: tuple[Problem, Fit, Ground]) -> None:
    problem, base, ground = posed
    model, found = candidate(posed, "first_order_lag", "y0")
    short = fit_beside(problem, model, base, ground, found.starts, hopeless=0.0)
    long = fit_beside(problem, model, base, ground, found.starts, hopeless=np.inf)
    assert short.evaluations < long.evaluations
