"""Recognises records in steady state: inputs and outputs that repeat from the first sample on."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from hal.arrays import Array
from sim_devices.physics.periods import period_of
from tools.numbers import rms

REPEATS = 1e-3
"""Largest rms difference of a commanded input from itself one period later, over its rms."""
OUTPUT_REPEATS = 0.05
"""Largest rms difference of an output from itself one period later, over its rms; it may hold noise."""
LOUDER_AT_FIRST = 1.5
"""Ratio of the rms of this difference at the start of a stretch to that of the rest, above which a transient decays."""
DRIFTS = 0.3
"""Ratio of the mean of this difference to its rms, above which the output drifts or has not settled."""
EXACT = 1e-6  # of the output's rms: differences below are rounding


def steady_period(inputs: Mapping[str, Array], outputs: Mapping[str, Array], starts: Sequence[int] = (0,)) -> int:
    """Return the number of samples after which every input and output (n,) repeats, in each stretch from its start on.

    The result is 0 if an input does not repeat within a whole number of samples, or if an output has a transient.
    ``starts``: first samples of the stretches, in order.
    """
    moving = [x for x in inputs.values() if float(np.std(x)) > 0.0]
    if not moving:
        return 0
    n = moving[0].size
    spans = list(zip(starts, (*starts[1:], n), strict=True))
    a, b = spans[0]
    found = period_of(max(moving, key=lambda x: float(np.std(x[a:b])))[a:b])
    if found is None:
        return 0
    lag = found.lag
    if any(b - a < 2 * lag for a, b in spans):
        return 0
    repeat = all(_difference(x[a:b], lag) <= REPEATS * float(np.std(x)) for x in moving for a, b in spans)
    return lag if repeat and all(_settled(y[a:b], lag) for y in outputs.values() for a, b in spans) else 0


def _difference(x: Array, lag: int) -> float:
    return rms(x[lag:] - x[:-lag])


def _settled(y: Array, lag: int) -> bool:
    d = y[lag:] - y[:-lag]
    size, all_of_it = float(np.std(y)), rms(d)
    early = max(8, lag // 8)
    if all_of_it > OUTPUT_REPEATS * np.sqrt(2.0) * size:
        return False
    if rms(d[:early]) <= EXACT * size:
        return True
    return rms(d[:early]) <= LOUDER_AT_FIRST * rms(d[early:]) and abs(float(np.mean(d))) <= DRIFTS * all_of_it
