"""Rate-dependent modified Prandtl-Ishlinskii hysteresis, creep, and the exact inverse (Ang 2004, 7.2, 7.3; errata
73-79).

Forward: z = x + creep(x), x = w_s . S_d(w_h(v) . H_r[u]): plays H_r of the drive with memory, weighted by slopes
W_i(v) = W_i + c_i v that depend on the rate v = |dz/dt| of the wanted stroke, then one-sided dead zones without
memory, then creep. The inverse keeps the forward play states and transforms them anew in every step (erratum 78).
Units: drive V, stroke m (slopes m/V), rate m/s; dead-zone thresholds in m.
"""

from __future__ import annotations

import numpy as np

from firmware_py.actuation.config import StackConfig
from firmware_py.records import Records, field, new, record
from hal.arrays import Array
from hal.compiled import kernel

UM = 1e-6


@record
class Operator:
    """The numbers of one stack."""

    centre_V: float = field("V")  # the plays see the drive less this
    level: float = field("m")  # and their sum counts from here
    r: Array = field("V", "plays")
    slope: Array = field("m/V", "plays")  # W_i, partial sums of the weights
    slope_per_rate: Array = field("s/V", "plays")  # c_i
    rate_high: Array = field("m/s", "plays")  # the law is held beyond
    rate_low: float = field("m/s")  # and below
    least_slope: float = field("m/V")
    d: Array = field("m", "zones")
    s: Array = field("1", "zones")
    d_inverse: Array = field("m", "zones")
    s_inverse: Array = field("1", "zones")
    offset: float = field("m")
    creep_share: Array = field("1", "creep")
    creep_keep: Array = field("1", "creep")  # of one tick
    creep_reference: float = field("m")  # stroke without creep at which it rests


def inverse_weights(w: Array) -> Array:
    """Ang 2004 (7.13), (7.14): weights of the inverse from the forward ones; partial sums must be positive."""
    sums = np.cumsum(w)
    return np.concatenate([[1.0 / w[0]], -w[1:] / (sums[1:] * sums[:-1])])


def inverse_thresholds(r: Array, w: Array) -> Array:
    """r'_i = sum_{j <= i} w_j (r_i - r_j)."""
    return np.array([np.sum(w[: i + 1] * (r[i] - r[: i + 1])) for i in range(len(r))])


def plays_at(stack: Operator, drive_V: float, high_V: float) -> Array:
    """Play states of a stack that was cycled over its range (0, ``high_V``, 0) and then driven up to ``drive_V``."""
    down = np.maximum(-stack.r, np.minimum(stack.r, np.maximum(high_V - stack.r, 0.0)))
    return np.maximum(drive_V - stack.r, down) - stack.centre_V


def sizes_of(*stacks: StackConfig) -> tuple[int, int, int]:
    """Plays, dead zones and creep elements that hold each of ``stacks``; in whole blocks, because every new size
    compiles the kernels anew. What is over does nothing."""

    def blocks(needed: int, block: int) -> int:
        return -(-max(needed, 1) // block) * block

    return (
        blocks(max(len(stack.play_thresholds_V) for stack in stacks), 16),
        blocks(max(len(stack.dead_zone_thresholds_um) for stack in stacks), 8),
        blocks(max(len(stack.creep_times_s) for stack in stacks), 4),
    )


def _fill(values: tuple[float, ...], n: int, rest: float, step: float = 0.0) -> Array:
    """``values`` and then ``rest``, ``rest + step``, ... to length ``n``."""
    filled = np.empty(n)
    filled[: len(values)] = values
    filled[len(values) :] = rest + step * np.arange(n - len(values))
    return filled


def operator_params(
    stack: StackConfig, tick_hz: float = 1000.0, sizes: tuple[int, int, int] | None = None
) -> Records[Operator]:
    """Return the kernels' numbers of one stack, filled up to ``sizes``."""
    plays, zones, creep = sizes or sizes_of(stack)
    r = _fill(stack.play_thresholds_V, plays, stack.play_thresholds_V[-1] + 1.0, 1.0)
    slope = np.cumsum(_fill(stack.play_weights_um_per_V, plays, 0.0)) * UM
    law = stack.slope_per_rate_s_per_V or (0.0,)
    high = stack.rate_high_um_per_s or (np.inf,)
    d = _fill(stack.dead_zone_thresholds_um, zones, stack.dead_zone_thresholds_um[-1] + 1.0, 1.0) * UM
    s = _fill(stack.dead_zone_weights, zones, 0.0)
    return new(
        Operator,
        centre_V=stack.centre_V,
        level=slope[-1] * stack.centre_V + stack.level_um * UM,
        r=r,
        slope=slope,
        slope_per_rate=_fill(law, plays, law[-1]),
        rate_high=_fill(high, plays, high[-1]) * UM,
        rate_low=stack.rate_low_um_per_s * UM,
        least_slope=stack.least_slope_um_per_V * UM,
        d=d,
        s=s,
        d_inverse=inverse_thresholds(d, s),
        s_inverse=inverse_weights(s),
        offset=stack.offset_um * UM,
        creep_share=_fill(stack.creep_shares, creep, 0.0),
        creep_keep=np.exp(-1.0 / (_fill(stack.creep_times_s, creep, 1.0) * tick_hz)),
    )


@kernel
def slopes_at(rate: float, stack: Operator, out: Array) -> bool:
    """``out`` (n,) = W_i at ``rate`` m/s, Ang 2004 (7.17), held at the ends of the law; True when one had to be
    limited.

    A slope that is not positive has no inverse (Ang 2004, 7.5): it is held at the least one.
    """
    limited = False
    for i in range(len(stack.r)):
        w = stack.slope[i] + stack.slope_per_rate[i] * min(max(rate, stack.rate_low), stack.rate_high[i])
        # also for nan
        if not w >= stack.least_slope:
            w = stack.least_slope
            limited = True
        out[i] = w
    return limited


@kernel
def play(x: float, states: Array, slopes: Array, r: Array) -> float:
    """w . H_r[x] with w_i = W_i - W_(i-1), Ang 2004 (7.1), (7.4), (7.18): moves the ``states`` and sums them."""
    total = 0.0
    before = 0.0
    for i in range(len(r)):
        y = max(x - r[i], min(x + r[i], states[i]))
        states[i] = y
        total += (slopes[i] - before) * y
        before = slopes[i]
    return total


@kernel
def play_inverse(h: float, states: Array, slopes: Array, r: Array) -> float:
    """x with w . H_r[x] = h, Ang 2004 (7.20), (7.21); ``states`` are the forward operator's and do not move.

    y'_i = W_i y_i + sum_{j > i} w_j y_j is carried from play to play as y'_(i-1) less the change.
    """
    n = len(r)
    mapped = 0.0
    for i in range(n):
        mapped += (slopes[i] - (slopes[i - 1] if i > 0 else 0.0)) * states[i]
    # y'_0 = W_0 y_0 + sum_{j > 0} w_j y_j is the whole sum; then y'_i = y'_(i-1) + W_(i-1) (y_i - y_(i-1))
    threshold = 0.0
    x = 0.0
    for i in range(n):
        if i > 0:
            mapped += slopes[i - 1] * (states[i] - states[i - 1])
            threshold += slopes[i - 1] * (r[i] - r[i - 1])
        weight = 1.0 / slopes[i] - (1.0 / slopes[i - 1] if i > 0 else 0.0)
        x += weight * max(h - threshold, min(h + threshold, mapped))
    return x


@kernel
def dead_zones(y: float, d: Array, s: Array) -> float:
    """s . S_d(y), Ang 2004 (7.7), (7.8); d[0] = 0 passes y of either sign."""
    total = s[0] * y
    for i in range(1, len(d)):
        total += s[i] * max(y - d[i], 0.0)
    return total


@kernel
def stack_stroke(drive_V: float, slopes: Array, plays: Array, creep: Array, stack: Operator) -> float:
    """Forward model, one tick: stroke m at ``drive_V``; moves ``plays`` and ``creep`` (m)."""
    y = play(drive_V - stack.centre_V, plays, slopes, stack.r) + stack.level
    x = dead_zones(y, stack.d, stack.s) + stack.offset
    z = x
    for j in range(len(creep)):
        keep = stack.creep_keep[j]
        creep[j] = keep * creep[j] + (1.0 - keep) * stack.creep_share[j] * (x - stack.creep_reference)
        z += creep[j]
    return z


@kernel
def drive(stroke_m: float, slopes: Array, plays: Array, creep: Array, stack: Operator) -> float:
    """Inverse model: drive V with which ``stroke`` would give ``stroke_m`` in this tick; nothing moves."""
    rest = stroke_m
    gain = 1.0
    for j in range(len(creep)):
        share = (1.0 - stack.creep_keep[j]) * stack.creep_share[j]
        gain += share
        rest += share * stack.creep_reference - stack.creep_keep[j] * creep[j]
    # rest = x (1 + shares): the creep of this very tick is part of what is wanted
    h = dead_zones(rest / gain - stack.offset, stack.d_inverse, stack.s_inverse)
    return play_inverse(h - stack.level, plays, slopes, stack.r) + stack.centre_V
