"""A search that begins on the first part of a long recording ends where one on the whole of it does."""

from __future__ import annotations

from unittest.mock import PropertyMock, patch

import numpy as np
import pytest
from scipy.signal import lfilter

from sim_devices.physics.catalogue import EFFECTS
from tests.unit.mismatch_engine.cases import recording, wave
from tools.mismatch.engine.fit import OPENING, fit
from tools.mismatch.engine.pose import prepared
from tools.mismatch.engine.problem import LEAST_OPENING, Problem
from tools.mismatch.engine.screen import bend, one_step, places
from tools.mismatch.infer import diagnose
from tools.mismatch.simulate import Model

RATE_HZ = 1000.0
TAU_S = 0.004


def lagging(seconds: float, *, louder_later: bool = False):
    """A stack behind an RC of 4 ms, driven by two lines; noise of a fiftieth of the lag's effect."""
    rng = np.random.default_rng(3)
    t = np.arange(round(seconds * RATE_HZ)) / RATE_HZ
    u = 50 + 20 * np.sin(2 * np.pi * 1.3 * t) + 8 * np.sin(2 * np.pi * 11.0 * t)
    if louder_later:
        u = np.where(t < 0.8 * t[-1], 50 + 0.3 * (u - 50), u)
    pole = np.exp(-1 / RATE_HZ / TAU_S)
    y = 0.13 * lfilter([1 - pole], [1, -pole], u - u[0]) + 0.13 * u[0] + 0.002 * rng.standard_normal(t.size)
    given = {"gain_um_per_V": 0.12, "offset_um": 0.1}
    return recording("piezo_stack", {"command": u}, {"displacement": y}, given, rate_hz=RATE_HZ)


def test_the_end_is_that_of_a_search_on_the_whole() -> None:
    problem, _, base = prepared(lagging(48.0), 0.3, 0, False)
    assert problem.opening is not None
    assert problem.opening.recording.n == LEAST_OPENING
    place = places(problem, (EFFECTS["first_order_lag"],), ())[0]
    candidate = one_step(problem, base, place, bend(problem, base))
    model = Model(problem.twin, (candidate.placed,))
    early = fit(problem, model, candidate.starts)
    with patch.object(Problem, "opening", new_callable=PropertyMock, return_value=None):
        late = fit(problem, model, candidate.starts)
    assert early.theta == pytest.approx(late.theta, rel=1e-4, abs=1e-7)
    assert early.cost == pytest.approx(late.cost, rel=1e-6)
    assert early.theta[model.n_base] == pytest.approx(TAU_S, rel=0.15)  # the filter above holds its input


def test_an_opening_is_simulated_as_the_whole_is() -> None:
    problem, _, base = prepared(lagging(48.0), 0.3, 0, False)
    opening = problem.opening
    assert opening is not None
    rows = opening.index.size
    np.testing.assert_array_equal(problem.index[:rows], opening.index)
    some, every = (base.model.residual(p.view, base.theta)["displacement"] for p in (opening, problem))
    np.testing.assert_allclose(some, every[:rows], rtol=0, atol=1e-12)
    inside = problem.fit_rows[problem.fit_rows < rows]
    np.testing.assert_array_equal(opening.fit_rows, inside)


def test_no_opening_of_a_short_recording_or_one_that_grows_louder() -> None:
    for one in (lagging(40.0), lagging(48.0, louder_later=True)):
        problem, _, _ = prepared(one, 0.3, 0, False)
        assert problem.opening is None


def test_what_may_happen_later_is_never_searched_on_the_opening() -> None:
    late = {"thermal_drift", "step_shift", "random_walk", "clock_skew", "dropped_samples", "spikes", "vibration"}
    assert not OPENING & late
    assert set(EFFECTS) >= OPENING
    assert not any(EFFECTS[name].needs or EFFECTS[name].test for name in OPENING)


def test_a_memory_that_began_before_the_record_is_no_drift() -> None:
    """Plays that a larger motion before the first sample has left off their middle (Krejci's operators, by hand)."""
    rng = np.random.default_rng(5)
    u = np.concatenate([np.linspace(0.0, 1.4, 100), np.linspace(1.4, 0.0, 100), wave(rng, 2000)])
    y = np.zeros(u.size)
    for radius, weight in ((0.1, 0.03), (0.25, 0.04), (0.45, 0.05), (0.7, 0.06)):
        p = 0.0
        for i, x in enumerate(u):
            p = min(max(p, x - radius), x + radius)
            y[i] += weight * p
    y = (5.0 * (u + y) + 0.02 * rng.standard_normal(u.size))[200:]
    given = {"gain_um_per_V": 5.0, "offset_um": 0.0}
    made = recording("piezo_stack", {"command": u[200:]}, {"displacement": y}, given, noise={"displacement": 0.02})
    names = ("hysteresis", "rate_dependent_hysteresis", "creep", "thermal_drift", "backlash", "ac_coupling")
    report = diagnose(made, effects=[EFFECTS[n] for n in names], jobs=1)
    assert [p.name for p in report.physics] == ["hysteresis"]
    assert report.verdict == "missing_physics"
