"""Reduces long records: effects are nominated on an excerpt and on a thinned copy, and decided on the whole."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from tools.mismatch.recording import Recording, Split
from tools.mismatch.twins.base import Twin

LONG = 40_000
"""Number of samples (of all outputs, for a twin with modes) above which the search starts on reduced copies. Half of
it was slower for 25,000 samples of an axis: a fit of a part costs more than its share."""
PART = 10_000
"""Number of samples of a reduced copy of a record that is not longer than ``VERY_LONG``."""
VERY_LONG = 200_000
LONG_PART = 60_000
"""Number of samples of a reduced copy of a longer record."""
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
"""Effects that a thinned copy may nominate: slower than its samples, or accumulated over the whole record."""
OVER_ALL = ("thermal_drift", "random_walk", "step_shift", "clock_skew", "dropped_samples")
"""Effects that are visible over the whole record only. All are nominated if no thinned copy can be simulated."""


def is_long(recording: Recording, twin: Twin) -> bool:
    """Return True if a search on the whole record takes minutes."""
    modes = hasattr(twin, "fastest_per_s")
    return recording.n * (len(recording.outputs) if modes else 1) > LONG


def part_of(recording: Recording) -> int:
    """Return the number of samples of the reduced copies."""
    return LONG_PART if recording.n > VERY_LONG else PART


def fitted_part(recording: Recording) -> Recording:
    """Return the part of a recording that its own split allows to fit; all of it without a split."""
    fit, test = recording.split.fit, recording.split.test
    if isinstance(fit, tuple):
        return _part(recording, slice(*fit), recording.dt)
    if isinstance(test, tuple):
        rest = max((0, test[0]), (test[1], recording.n), key=lambda r: r[1] - r[0])
        return _part(recording, slice(*rest), recording.dt)
    return recording


def excerpt(recording: Recording, samples: int = LONG_PART) -> Recording:
    """Return the contiguous stretch with the busiest inputs (largest mean square rate), at full rate."""
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


def thinned_copy(recording: Recording, samples: int = LONG_PART) -> Recording:
    """Return block means of every channel, so that about ``samples`` are left."""
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
        segments=tuple(s // k for s in recording.segments if 0 < s // k < m),
        parts=(),
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
        segments=recording.segments_of(part.start, part.stop),
        parts=(),
    )
