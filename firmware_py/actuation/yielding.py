"""Lets motion outside the core tremor band yield, slowly and early, where the stroke does not suffice for all.

A clipped slow swing has harmonics in the very band that matters. So what is wanted is split into the core (what the
estimator says of 8 to 12 Hz) and the rest; the rest is scaled so that, beside the core's recent peaks, its own recent
peaks stay inside. A peak is followed at once and forgotten slowly, so the scale falls as fast as a new peak grows
(the product stays continuous) and is nearly constant in between: a scale that moved within a cycle would make harmonics
itself. The part of the rest that tilts the shaft has room before the part along it: it costs an eighth of the stroke.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from firmware_py.records import Record
from hal.compiled import kernel
from hal.scratch import scratch

Array = NDArray[np.float64]

YIELD_STATE = np.dtype(
    [
        ("tilt", "f8", (2,)),  # of the shaft under the core alone, where the next inverse kinematics starts
        ("core_peak", "f8", (3,)),  # m of stroke
        ("side_peak", "f8", (3,)),  # m of stroke, as let through
        ("side_over", "f8"),  # recent peak of the tilting rest over its room
        ("axial_over", "f8"),
    ]
)
LEAST_ROOM = 0.1  # of a stroke's half range whatever the core takes, of that room whatever tilts the shaft


@kernel
def yield_rest(stroke: Array, core: Array, low: Array, high: Array, keep: float, state: Record) -> bool:
    """Replace ``stroke`` (3,) m by ``core`` (3,) plus the share of the rest that is let through. Return True if
    anything was held back.

    ``low``, ``high`` (3,): ends of the strokes from neutral; ``keep``: what is kept of a peak per tick.
    """
    mean = 0.0
    for i in range(3):
        if not (np.isfinite(stroke[i]) and np.isfinite(core[i])):
            return False  # no inverse: the nearest reachable position is found instead, and no peak is remembered
        mean += (stroke[i] - core[i]) / 3.0
    room = scratch(3)
    over = 0.0
    for i in range(3):
        half = min(high[i], -low[i])
        state.core_peak[i] = max(keep * state.core_peak[i], abs(core[i]))
        room[i] = max(LEAST_ROOM * half, half - state.core_peak[i])
        over = max(over, abs(stroke[i] - core[i] - mean) / ((1.0 - LEAST_ROOM) * room[i]))
    state.side_over = max(keep * state.side_over, over)
    side = 1.0 / max(1.0, state.side_over)
    over = 0.0
    for i in range(3):
        state.side_peak[i] = max(keep * state.side_peak[i], side * abs(stroke[i] - core[i] - mean))
        # of the room, as much as LEAST_ROOM is always left
        over = max(over, abs(mean) / (room[i] - min(state.side_peak[i], (1.0 - LEAST_ROOM) * room[i])))
    state.axial_over = max(keep * state.axial_over, over)
    axial = 1.0 / max(1.0, state.axial_over)
    if side == 1.0 and axial == 1.0:
        return False
    for i in range(3):
        stroke[i] = core[i] + side * (stroke[i] - core[i] - mean) + axial * mean
    return True
