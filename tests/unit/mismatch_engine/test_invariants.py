"""What every fit of the base parameters holds, whatever the twin, the belief and the noise."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from tests.unit.mismatch_engine.cases import RATE, recording
from tools.mismatch.engine.fit import as_given
from tools.mismatch.engine.pose import prepared
from tools.mismatch.engine.residual import residuals
from tools.mismatch.engine.trust import broken, fit_loss
from tools.mismatch.export.run import whole_run
from tools.mismatch.recording import Recording
from tools.mismatch.simulate import Model
from tools.mismatch.simulate_view import View
from tools.mismatch.twins.make import make

Array = np.ndarray
N = 500
REACH = 30.0
"""Recorded ranges that a simulation may be off at any sample of the record."""


def plant(rng: np.random.Generator, order: int, stretch: float) -> Array:
    """A stable plant (order, order) in blocks of one or two poles, all rates multiplied by ``stretch``."""
    a = np.zeros((order, order))
    for i in range(0, order, 2):
        w = stretch * np.exp(rng.uniform(np.log(8.0), np.log(400.0)))
        z = np.exp(rng.uniform(np.log(0.02), np.log(0.9)))
        if i + 1 < order:
            a[i : i + 2, i : i + 2] = [[0.0, w], [-w, -2 * z * w]]
        else:
            a[i, i] = -w
    return a


def made(seed: int, order: int, inputs: int, outputs: int, stretch: float, gain: float, noise: float) -> Recording:
    """A linear plant with an offset and a start of its own; the belief has other rates and gains."""
    rng = np.random.default_rng(seed)
    a = plant(np.random.default_rng(seed), order, 1.0)
    b, c = rng.standard_normal((order, inputs)), rng.standard_normal((outputs, order))
    u = {f"u{i}": np.repeat(rng.standard_normal(N // 5), 5) for i in range(inputs)}
    truth = {
        "A": a.tolist(),
        "B": b.tolist(),
        "C": c.tolist(),
        "hold": "zero",
        "x0": rng.standard_normal(order).tolist(),
    }
    blank = {f"y{k}": np.cos(np.arange(N)) for k in range(outputs)}
    clean = recording("state_space", u, blank, truth)
    model = Model(make(clean))
    y = model.simulate(View.whole(clean), model.start(clean))
    y = {o: 0.3 + v + noise * float(np.std(v)) * rng.standard_normal(N) for o, v in y.items()}
    believed = plant(np.random.default_rng(seed), order, stretch)
    belief = {"A": believed.tolist(), "B": (gain * b).tolist(), "C": c.tolist(), "hold": "zero"}
    return recording("state_space", u, y, belief)


@pytest.mark.slow
@settings(max_examples=12, deadline=None, suppress_health_check=[HealthCheck.too_slow])
@given(
    seed=st.integers(0, 10**6),
    order=st.integers(1, 7),
    inputs=st.integers(1, 2),
    outputs=st.integers(1, 2),
    stretch=st.floats(0.5, 2.0),
    gain=st.sampled_from([1.0, -1.0, 0.2, 30.0]),
    noise=st.sampled_from([0.001, 0.1, 3.0]),
)
def test_a_refit_is_no_worse_stays_in_reach_stays_stable_and_is_written_as_it_is(
    seed: int, order: int, inputs: int, outputs: int, stretch: float, gain: float, noise: float
) -> None:
    rec = made(seed, order, inputs, outputs, stretch, gain, noise)
    problem, _, base = prepared(rec, 0.3, 0, False)
    believed = as_given(problem)
    assert broken(problem, believed.residual, base.theta, base.residual) == ""
    assert fit_loss(problem, base.residual) <= fit_loss(problem, believed.residual)
    for o, r in base.residual.items():
        assert np.max(np.abs(r)) < REACH * np.ptp(rec.outputs[o])
        assert problem.floors[o].rms < np.ptp(rec.outputs[o])
    poles = np.linalg.eigvals(base.model.twin.plant_of(base.theta).a)  # type: ignore[attr-defined]
    assert np.max(poles.real) <= 1e-9 * np.max(np.abs(poles))
    again = replace(rec, twin=replace(rec.twin, parameters=base.model.twin.to_text(base.theta)))
    twin = make(again)
    read = replace(problem, recording=again, twin=twin if twin.restart == problem.twin.restart else problem.twin)
    there = residuals(read, Model(twin), twin.start(again))
    whole = base.model.whole(problem.view, base.theta)
    before = believed.model.whole(problem.view, believed.theta)
    run_again = whole_run(again, Model(twin), twin.start(again))
    for o, r in base.residual.items():
        size = float(np.ptp(rec.outputs[o]))
        np.testing.assert_allclose(there[o], r, atol=1e-5 * size)
        # a belief that is far off everywhere (a gain thirty times too high) may be what is left
        allowed = max(REACH * size, float(np.max(np.abs(before[o] - rec.outputs[o]))))
        assert np.max(np.abs(whole[o] - rec.outputs[o])) <= allowed
        assert np.max(np.abs(run_again[o] - rec.outputs[o])) <= 2 * allowed


def test_a_blow_at_the_first_samples_is_scored() -> None:
    """All that the record shows is over after 2 % of it."""
    n, w, z = 4000, 2 * np.pi * 60, 0.15
    t = np.arange(n) / RATE
    force = np.where((t > 0.01) & (t < 0.014), 1.0, 0.0)
    true = recording("state_space", {"f": force}, {"y": np.cos(t)}, oscillator(w, z))
    model = Model(make(true))
    y = model.simulate(View.whole(true), model.start(true))["y"]
    y = y + 1e-3 * float(np.max(y)) * np.random.default_rng(0).standard_normal(n)
    rec = recording("state_space", {"f": force}, {"y": y}, oscillator(1.15 * w, 0.7 * z))
    problem, _, base = prepared(rec, 0.3, 0, False)
    assert problem.index[problem.fit_rows[0]] <= 5
    assert base.theta[0] == pytest.approx(w, rel=0.01)
    assert base.theta[1] == pytest.approx(z, rel=0.05)


def oscillator(w: float, z: float) -> dict[str, object]:
    return {"A": [[0.0, 1.0], [-w * w, -2 * z * w]], "B": [[0.0], [w * w]], "C": [[1.0, 0.0]], "hold": "zero"}


def test_a_mode_that_no_input_moves_is_kept_for_the_run_that_it_started_in() -> None:
    """The payload swings from its start on; the force does not move it, and the twin knows how it swings."""
    n = 1500
    t = np.arange(n) / RATE
    u = np.repeat(np.random.default_rng(1).standard_normal(n // 5), 5)
    a = np.zeros((3, 3))
    a[0, 0] = -40.0
    a[1:, 1:] = [[0.0, 1.0], [-400.0, -0.4]]
    matrices: dict[str, object] = {"A": a.tolist(), "B": [[40.0], [0.0], [0.0]], "C": [[1.0, 1.0, 0.0]], "hold": "zero"}
    rec = recording("state_space", {"u": u}, {"y": np.cos(t)}, matrices | {"x0": [0.0, 2.0, 0.0]})
    model = Model(make(rec))
    y = model.simulate(View.whole(rec), model.start(rec))["y"] + 0.01 * np.random.default_rng(2).standard_normal(n)
    problem, _, base = prepared(
        replace(rec, outputs={"y": y}, twin=replace(rec.twin, parameters=matrices)), 0.3, 0, False
    )
    rows = problem.held_rows
    assert float(np.sqrt(np.mean(base.residual["y"][rows] ** 2))) < 0.012
