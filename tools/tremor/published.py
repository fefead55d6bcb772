"""The signals of `algorithms.md` (tasks 1 and 2) as that page describes them; its own generator is not published.

Two tones between 8 and 12 Hz whose amplitude and frequency wander, 50 um rms; task 2 adds 300 um rms of voluntary
motion below 0.6 Hz and 1 um of white noise. Displacement at 1 kHz.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.signal import butter, sosfilt

from tools.tremor.cases import RATE_HZ, Case

Array = NDArray[np.float64]
TREMOR_M, VOLUNTARY_M, NOISE_M = 50e-6, 300e-6, 1e-6
_RUN_IN_S = 20.0


def _smooth(rng: np.random.Generator, n: int, corner_hz: float) -> Array:
    """Unit rms, low-passed."""
    extra = round(_RUN_IN_S * RATE_HZ)
    x = np.asarray(sosfilt(butter(3, corner_hz, fs=RATE_HZ, output="sos"), rng.standard_normal(n + extra)))[extra:]
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
    slow = VOLUNTARY_M * _smooth(rng, n, 0.6) if task == 2 else np.zeros(n)
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
