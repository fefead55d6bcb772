"""Lets motion outside the core tremor band yield, slowly and early, where the stroke does not suffice for all.

A clipped slow swing has harmonics in the very band that matters. So what is wanted is split into the core (what the
estimator says of 8 to 12 Hz) and the rest; the rest is scaled so that, beside the core's recent peaks, its own recent
swings stay inside. A swing is followed soon (``attack``) and forgotten slowly, so the scale is nearly constant: a scale
that moved within a cycle would make harmonics itself. A swing is known before its peak, from where it is and how it
moves: a scale that followed the position alone would hold the tip at each new peak, and such corners shake the tip
above the band. The part of the rest that tilts the shaft has room before the part along it: it costs an eighth of
the stroke.

A core that is itself beyond the stroke has corners where it is clipped, and these shake the tip above the band. So its
swing is kept within ``overdrive`` strokes, by a scale that follows the swing and not its phase.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from firmware_py.records import field, record
from hal.arrays import Array
from hal.compiled import kernel
from hal.scratch import scratch


class Swing(NamedTuple):
    """Strokes from neutral (3,), m: those of all that is wanted, and of the core alone."""

    stroke: Array
    core: Array


class YieldLimits(NamedTuple):
    """Ends of the strokes (3,), m from neutral; what is kept of a peak per tick; ``ActuationConfig.overdrive``,
    ``overdrive_tilts`` and ``overdrive_tilt``; share of the way to a larger scale in a tick (1: all of it, and the
    rest's swing is its position)."""

    low: Array
    high: Array
    keep: float
    overdrive: float
    tilts: int
    tilt: float
    attack: float


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
    rest_last: Array = field("m", 3)  # of stroke, a tick ago
    rest_power: float = field("m^2")  # recent mean square of the rest
    rest_change: float = field("m^2")  # that of its change in a tick
    scale: Array = field("1", 4)  # what the swings are divided by: core, its tilt, side, axial; 0 is 1


LEAST_SHRINK = 1e-4  # of the swing: less is nothing
CORE, TILT, SIDE, AXIAL = range(4)  # of ``YieldState.scale``
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
    low, high, keep, overdrive, tilts, most_tilt, attack = limits
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
            most = most_tilt * min(high[i], -low[i])
            if size > most:
                tilt = min(tilt, most / size)
        state.tilt_over = _remembered(state.tilt_over, tilt, forget)
        tilt = 1.0 / _followed(state.scale, TILT, state.tilt_over, attack)
    along = mean * mean + turned * turned
    share = 1.0
    for i in range(3):
        side, across = tilt * (core[i] - mean), tilt * (ticks * (core[i] - state.core_last[i]) - turned)
        state.core_last[i] = core[i]
        half, own = min(high[i], -low[i]), np.sqrt(side * side + across * across)
        most = max(overdrive * half, min(own, most_tilt * half))  # a tilt that may be larger leaves the shaft nothing
        # the largest share for which |side phasor + share * axial phasor| <= most
        both = side * mean + across * turned
        room = most * most - side * side - across * across
        if overdrive > 0.0 and along + 2.0 * both > room:
            share = min(share, (np.sqrt(both * both + along * room) - both) / along if room > 0.0 else 0.0)
    state.core_over = _remembered(state.core_over, share, forget)
    over = _followed(state.scale, CORE, state.core_over, attack)
    if over <= 1.0 + LEAST_SHRINK and tilt >= 1.0 - LEAST_SHRINK:
        return False
    for i in range(3):
        excess = (1.0 - 1.0 / over) * mean
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
def _followed(scale: Array, which: int, wanted: float, attack: float) -> float:
    """Return ``scale[which]``: it approaches a larger ``wanted`` by ``attack`` per tick, a smaller one at once."""
    wanted = max(1.0, wanted)
    last = max(1.0, scale[which])
    scale[which] = last + attack * (wanted - last) if attack < 1.0 and wanted > last else wanted
    return scale[which]


@kernel
def yield_rest(swing: Swing, state: YieldState, limits: YieldLimits) -> bool:
    """Replace the stroke of ``swing`` by its core plus the share of the rest that is let through. Return True if
    anything was held back."""
    stroke, core = swing
    low, high, keep, attack = limits.low, limits.high, limits.keep, limits.attack
    mean = 0.0
    for i in range(3):
        if not (np.isfinite(stroke[i]) and np.isfinite(core[i])):
            return False  # no inverse: the nearest reachable position is found instead, and no peak is remembered
        mean += (stroke[i] - core[i]) / 3.0
    power = change = turned = 0.0
    for i in range(3):
        rest = stroke[i] - core[i]
        by = rest - state.rest_last[i]
        power += rest * rest
        change += by * by
        turned += by / 3.0
    state.rest_power = keep * state.rest_power + (1.0 - keep) * power
    state.rest_change = keep * state.rest_change + (1.0 - keep) * change
    ticks = np.sqrt(state.rest_power / state.rest_change) if attack < 1.0 and state.rest_change > 0.0 else 0.0
    room = scratch(3)
    over = 0.0
    for i in range(3):
        half = min(high[i], -low[i])
        state.core_peak[i] = max(keep * state.core_peak[i], abs(core[i]))
        room[i] = max(LEAST_ROOM * half, half - state.core_peak[i])
        rest = stroke[i] - core[i]
        away, across = rest - mean, ticks * (rest - state.rest_last[i] - turned)
        state.rest_last[i] = rest
        over = max(over, np.sqrt(away * away + across * across) / ((1.0 - LEAST_ROOM) * room[i]))
    state.side_over = max(keep * state.side_over, over)
    side = 1.0 / _followed(state.scale, SIDE, state.side_over, attack)
    over = 0.0
    across = ticks * turned
    size = np.sqrt(mean * mean + across * across)
    for i in range(3):
        state.side_peak[i] = max(keep * state.side_peak[i], side * abs(stroke[i] - core[i] - mean))
        # of the room, as much as LEAST_ROOM is always left
        over = max(over, size / (room[i] - min(state.side_peak[i], (1.0 - LEAST_ROOM) * room[i])))
    state.axial_over = max(keep * state.axial_over, over)
    axial = 1.0 / _followed(state.scale, AXIAL, state.axial_over, attack)
    if side == 1.0 and axial == 1.0:
        return False
    for i in range(3):
        stroke[i] = core[i] + side * (stroke[i] - core[i] - mean) + axial * mean
    return True
