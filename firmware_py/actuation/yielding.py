"""Lets motion outside the core tremor band yield, slowly and early, where the stroke does not suffice for all.

A clipped slow swing has harmonics in the very band that matters. So what is wanted is split into the core (what the
estimator says of 8 to 12 Hz) and the rest; the rest is scaled so that, beside the core's recent peaks, its own recent
peaks stay inside. A peak is followed at once and forgotten slowly, so the scale falls as fast as a new peak grows
(the product stays continuous) and is nearly constant in between: a scale that moved within a cycle would make harmonics
itself. The part of the rest that tilts the shaft has room before the part along it: it costs an eighth of the stroke.

A core that is itself beyond the stroke has corners where it is clipped, and these shake the tip above the band. So its
swing is kept within ``overdrive`` strokes, by a scale that follows the swing and not its phase.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from firmware_py.records import Array, field, record
from hal.compiled import kernel
from hal.scratch import scratch


class Swing(NamedTuple):
    """Strokes from neutral (3,), m: those of all that is wanted, and of the core alone."""

    stroke: Array
    core: Array


class YieldLimits(NamedTuple):
    """Ends of the strokes (3,), m from neutral; what is kept of a peak per tick; ``ActuationConfig.overdrive`` and
    ``overdrive_tilts``."""

    low: Array
    high: Array
    keep: float
    overdrive: float
    tilts: int


@record
class YieldState:
    """Recent peaks and powers of the core and of the rest."""

    tilt: Array = field("rad", 2)  # of the shaft under the core alone, where the next inverse kinematics starts
    core_last: Array = field("m", 3)  # of stroke, a tick ago
    core_power: float = field("m^2")  # recent mean square of the core
    core_change: float = field("m^2")  # that of its change in a tick
    core_over: float = field("1")  # recent peak of the core's swing over what is let through
    tilt_over: float = field("1")  # the same of the swing's tilt
    core_peak: Array = field("m", 3)  # of stroke
    side_peak: Array = field("m", 3)  # of stroke, as let through
    side_over: float = field("1")  # recent peak of the tilting rest over its room
    axial_over: float = field("1")


LEAST_SHRINK = 1e-4  # of the swing: less is nothing
LEAST_ROOM = 0.1  # of a stroke's half range whatever the core takes, of that room whatever tilts the shaft


@kernel
def shrink_core(swing: Swing, state: YieldState, limits: YieldLimits) -> bool:
    """Shrink the core of ``swing`` to ``overdrive`` times the stroke at most, and its stroke by as much. Return True if
    anything was shrunk.

    A swing is x and its quadrature: the change in a tick over the angle that the core turns in a tick (the root of the
    ratio of their mean squares, remembered by ``keep`` per tick). The scale falls at once and recovers within half a
    turn. With ``tilts`` the tilt is shrunk first, as far as it is beyond the limit by itself; the swing along the shaft
    gets what the tilt leaves of each stroke, added as phasors. ``overdrive`` 0 shrinks nothing.
    """
    stroke, core = swing
    low, high, keep, overdrive, tilts = limits
    mean = turned = power = change = 0.0
    for i in range(3):
        if not (np.isfinite(stroke[i]) and np.isfinite(core[i])):
            return False
        by = core[i] - state.core_last[i]
        mean += core[i] / 3.0
        turned += by / 3.0
        power += core[i] * core[i]
        change += by * by
    state.core_power = keep * state.core_power + (1.0 - keep) * power
    state.core_change = keep * state.core_change + (1.0 - keep) * change
    ticks = np.sqrt(state.core_power / state.core_change) if state.core_change > 0.0 else 0.0  # for one radian
    turned *= ticks
    forget = np.exp(-1.0 / (np.pi * ticks)) if ticks > 0.0 else 0.0
    tilt = 1.0
    if tilts != 0 and overdrive > 0.0:
        for i in range(3):
            side, across = core[i] - mean, ticks * (core[i] - state.core_last[i]) - turned
            size = np.sqrt(side * side + across * across)
            most = overdrive * min(high[i], -low[i])
            if size > most:
                tilt = min(tilt, most / size)
        state.tilt_over = _remembered(state.tilt_over, tilt, forget)
        tilt = 1.0 / state.tilt_over
    along = mean * mean + turned * turned
    share = 1.0
    for i in range(3):
        side, across = tilt * (core[i] - mean), tilt * (ticks * (core[i] - state.core_last[i]) - turned)
        state.core_last[i] = core[i]
        most = overdrive * min(high[i], -low[i])
        # the largest share for which |side phasor + share * axial phasor| <= most
        both = side * mean + across * turned
        room = most * most - side * side - across * across
        if most > 0.0 and along + 2.0 * both > room:
            share = min(share, (np.sqrt(both * both + along * room) - both) / along if room > 0.0 else 0.0)
    state.core_over = _remembered(state.core_over, share, forget)
    if state.core_over <= 1.0 + LEAST_SHRINK and tilt >= 1.0 - LEAST_SHRINK:
        return False
    for i in range(3):
        excess = (1.0 - 1.0 / state.core_over) * mean
        if tilt < 1.0:
            excess += (1.0 - tilt) * (core[i] - mean)
        core[i] -= excess
        stroke[i] -= excess
    return True


@kernel
def _remembered(over: float, share: float, forget: float) -> float:
    """Return by how much a swing is over: it follows 1 / ``share`` at once and forgets by ``forget`` per tick."""
    recent = 1.0 + forget * (max(1.0, over) - 1.0)
    return max(recent, 1.0 / max(share, LEAST_ROOM))


@kernel
def yield_rest(swing: Swing, state: YieldState, limits: YieldLimits) -> bool:
    """Replace the stroke of ``swing`` by its core plus the share of the rest that is let through. Return True if
    anything was held back."""
    stroke, core = swing
    low, high, keep = limits.low, limits.high, limits.keep
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
