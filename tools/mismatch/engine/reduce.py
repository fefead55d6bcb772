"""Long records: effects are nominated on an excerpt and on a thinned copy, and decided on everything."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from tools.mismatch.recording import Recording, Split

LONG = 200_000  # samples above which the search starts on reduced copies
PART = 60_000
SLOW = (
    "thermal_drift",
    "temperature_sensitivity",
    "supply_sensitivity",
    "current_coupling",
    "random_walk",
    "step_shift",
    "creep",
    "clock_skew",
    "dropped_samples",
    "ac_coupling",
    "hysteresis",
    "static_nonlinearity",
)
"""What a thinned copy may nominate: slower than its samples, or grown over the whole record."""


def excerpt(recording: Recording, samples: int = PART) -> Recording:
    """The contiguous stretch in which the inputs are busiest (largest mean square rate), at full rate."""
    n = recording.n
    if n <= samples:
        return recording
    energy = np.zeros(n)
    for x in recording.inputs.values():
        rate = np.gradient(x)
        energy += (rate / (np.std(rate) or 1.0)) ** 2
    total = np.concatenate([[0.0], np.cumsum(energy)])
    starts = np.arange(0, n - samples + 1, max(1, samples // 4))
    a = int(starts[int(np.argmax(total[starts + samples] - total[starts]))])
    return _part(recording, slice(a, a + samples), recording.dt)


def thinned_copy(recording: Recording, samples: int = PART) -> Recording:
    """Block means of every channel, so that about ``samples`` are left."""
    k = max(1, recording.n // samples)
    if k == 1:
        return recording
    m = recording.n // k

    def mean(x: np.ndarray) -> np.ndarray:
        return x[: m * k].reshape(m, k).mean(axis=1)

    return replace(
        recording,
        t=np.arange(m) * recording.dt * k,
        dt=recording.dt * k,
        inputs={s: mean(x) for s, x in recording.inputs.items()},
        outputs={s: mean(x) for s, x in recording.outputs.items()},
        context={s: mean(x) for s, x in recording.context.items()},
        noise=dict.fromkeys(recording.noise),
        split=Split(),
    )


def _part(recording: Recording, part: slice, dt: float) -> Recording:
    return replace(
        recording,
        t=recording.t[part] - recording.t[part][0],
        dt=dt,
        inputs={s: x[part] for s, x in recording.inputs.items()},
        outputs={s: x[part] for s, x in recording.outputs.items()},
        context={s: x[part] for s, x in recording.context.items()},
        split=Split(),
    )
