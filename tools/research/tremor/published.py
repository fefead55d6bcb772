"""The signals of `algorithms.md` (tasks 1 and 2) as that page describes them, and what tells whether they are alike.

Two tones between 8 and 12 Hz whose amplitude and frequency wander, 50 um rms; task 2 adds 300 um rms of voluntary
motion below 0.6 Hz and 1 um of white noise. Displacement at 1 kHz. That page's generator is not published, but three
of its figures need no estimator: the last value held, a band-pass of 6 to 14 Hz alone, and the best filter of 200 taps
trained on other records. With a voluntary motion of second order (and a band-pass of first order) they come out within
a tenth; a third order would leave 7 % behind the 200 taps instead of 21.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view
from scipy.signal import butter, lfilter, sosfilt

from hal.arrays import Array
from tools.research.tremor.bound import SKIP_S
from tools.research.tremor.cases import RATE_HZ, Case

TREMOR_M, VOLUNTARY_M, NOISE_M = 50e-6, 300e-6, 1e-6
VOLUNTARY_ORDER = 2
TAPS = 200
_RUN_IN_S = 20.0
_EVERY = 7  # samples between rows of the regression


def _smooth(rng: np.random.Generator, n: int, corner_hz: float, order: int = 3) -> Array:
    """Unit rms, low-passed."""
    extra = round(_RUN_IN_S * RATE_HZ)
    x = np.asarray(sosfilt(butter(order, corner_hz, fs=RATE_HZ, output="sos"), rng.standard_normal(n + extra)))[extra:]
    return x / np.std(x)


def published_case(task: int, seed: int, seconds: float = 20.0) -> Case:
    """``task`` 1: isolated tremor without noise; 2: with voluntary motion and noise."""
    rng = np.random.default_rng(seed)
    n = round(seconds * RATE_HZ)
    tremor = np.zeros(n)
    for _ in range(2):
        hz = rng.uniform(8.0, 12.0) + 0.3 * _smooth(rng, n, 0.3)
        size = 1.0 + 0.3 * _smooth(rng, n, 0.3)
        tremor += size * np.sin(2.0 * np.pi * np.cumsum(hz) / RATE_HZ + rng.uniform(0.0, 2.0 * np.pi))
    tremor *= TREMOR_M / np.std(tremor)
    slow = VOLUNTARY_M * _smooth(rng, n, 0.6, VOLUNTARY_ORDER) if task == 2 else np.zeros(n)
    noise = NOISE_M * rng.standard_normal(n) if task == 2 else np.zeros(n)
    return Case(
        f"task {task}, seed {seed}",
        f"algorithms.md task {task}",
        str(seed),
        "displacement",
        (slow + tremor + noise)[:, None],
        tremor[:, None],
        10.0,
        slow=slow[:, None] if task == 2 else None,
    )


def held(cases: Sequence[Case], horizon_ms: int) -> float:
    """Left, percent of the tremor's rms (mean over ``cases``), when the present tremor stands for the one to come."""
    return _mean_left([(case.truth[:, 0], case.truth[:, 0]) for case in cases], horizon_ms)


def band_passed(cases: Sequence[Case], horizon_ms: int) -> float:
    """The same with a causal band-pass of the samples, 6 to 14 Hz, Butterworth of first order."""
    sos = butter(1, (6.0, 14.0), btype="bandpass", fs=RATE_HZ, output="sos")
    return _mean_left([(c.truth[:, 0], np.asarray(sosfilt(sos, c.samples[:, 0]))) for c in cases], horizon_ms)


def two_hundred_taps(cases: Sequence[Case], others: Sequence[Case], horizon_ms: int) -> float:
    """The same with the best filter of ``TAPS`` taps of ``others``."""
    ticks = round(horizon_ms * 1e-3 * RATE_HZ)
    matrix, right = np.zeros((TAPS, TAPS)), np.zeros(TAPS)
    for case in others:
        rows = np.arange(TAPS - 1, len(case.truth) - ticks, _EVERY)
        past = sliding_window_view(case.samples[:, 0], TAPS)[rows - TAPS + 1, ::-1]
        matrix += past.T @ past
        right += past.T @ case.truth[rows + ticks, 0]
    taps = np.linalg.solve(matrix + 1e-12 * np.trace(matrix) * np.eye(TAPS), right)
    return _mean_left([(c.truth[:, 0], np.asarray(lfilter(taps, 1.0, c.samples[:, 0]))) for c in cases], horizon_ms)


def _mean_left(pairs: Sequence[tuple[Array, Array]], horizon_ms: int) -> float:
    ticks = round(horizon_ms * 1e-3 * RATE_HZ)
    skip = round(SKIP_S * RATE_HZ)
    lefts = [t[skip + ticks :] - p[skip : len(p) - ticks] for t, p in pairs]
    return float(np.mean([100.0 * np.std(e) / np.std(t[skip:]) for e, (t, _) in zip(lefts, pairs, strict=True)]))
