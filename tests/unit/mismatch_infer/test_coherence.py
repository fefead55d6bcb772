"""A rest that is coherent with what moves is no noise, whatever its colour."""

from __future__ import annotations

import numba
import numpy as np
import pytest
from scipy.signal import lfilter

from sim_devices.physics.catalogue import EFFECTS
from sim_devices.physics.effect import Array
from sim_devices.physics.statistics import whiten
from tests.unit.mismatch_engine.cases import recording
from tools.mismatch.engine.pose import prepared
from tools.mismatch.infer import diagnose
from tools.mismatch.infer.coherence import coherence, coherent_with

RATE_HZ = 200.0


@pytest.mark.parametrize("segments", [16, 64])
@pytest.mark.parametrize("colour", [0.0, 0.95])
def test_noise_of_any_colour_is_as_coherent_as_its_p_value_says(segments: int, colour: float) -> None:
    rng = np.random.default_rng(5)
    moves = lfilter([1.0], [1.0, -1.6, 0.8], rng.standard_normal((300, 64 * 70)))
    noise = lfilter([1.0], [1.0, -colour], rng.standard_normal(moves.shape))
    p = np.array([coherence(whiten(a), whiten(b), segments)[1] for a, b in zip(moves, noise, strict=True)])
    assert np.mean(p < 0.05) == pytest.approx(0.05, abs=0.04)  # three standard errors
    assert np.mean(p < 0.5) == pytest.approx(0.5, abs=0.09)


def test_a_filtered_signal_is_wholly_coherent() -> None:
    moves = np.random.default_rng(1).standard_normal(8000)
    share, p = coherence(moves, lfilter([0.2], [1.0, -0.8], moves), 16)
    assert share > 0.95
    assert p == 0.0
    assert coherence(np.zeros(8000), moves, 16) == (0.0, 1.0)


@numba.njit
def swung(u: Array, rate_rad_s: float, damping: float) -> Array:
    """Return the course (n,) of x'' = u - damping x' - rate^2 x, in 20 steps a sample."""
    out = np.empty(u.size)
    h = 1.0 / (RATE_HZ * 20)
    x, v = 0.0, 0.0
    for k in range(u.size):
        out[k] = x
        for _ in range(20):
            v += h * (u[k] - damping * v - rate_rad_s**2 * x)
            x += h * v
    return out


@pytest.mark.parametrize("carried", [True, False])
def test_what_an_input_does_by_a_path_of_its_own_is_no_noise_and_ringing_noise_is(carried: bool) -> None:
    rng = np.random.default_rng(8)
    u, other, noise = rng.standard_normal((3, 6000))
    left = swung(other if carried else noise, 75.0, 1.0)
    y = swung(u, 30.0, 4.0)
    left *= 0.3 * np.std(y) / np.std(left)
    y = y + left + 0.02 * np.std(left) * rng.standard_normal(u.size)
    parameters = {"A": [[0.0, 1.0], [-900.0, -4.0]], "B": [[0.0, 0.0], [1.0, 0.0]], "C": [[1.0, 0.0]], "hold": "zero"}
    rec = recording("state_space", {"u": u, "other": other}, {"x": y}, parameters, rate_hz=RATE_HZ)
    problem, _, base = prepared(rec, 0.3, 0, False)
    found = coherent_with(problem, base, "x")
    assert (found is not None and found.signal == "other") is carried
    report = diagnose(rec, jobs=1, effects=[EFFECTS[n] for n in ("dead_time", "first_order_lag")])
    assert report.physics == ()
    assert (report.verdict == "unexplained") is carried
