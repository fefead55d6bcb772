"""Integrates a linear plant with forces that depend on its own position and velocity, in free run."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from hal.compiled import kernel
from sim_devices.physics.effect import Array
from sim_devices.physics.forces import COGGING, FRICTION, SPRING, bristle_after, friction_limit, smooth_force
from tools.mismatch.twins.base import Force

FASTEST = "fastest_per_s"
"""Name of a setting of a placed force: the rate of the fastest mode of the twin in which it was fitted. The time step
follows that rate, so that a corrected twin, whose own modes differ, is integrated like the original fit."""


class Rows(NamedTuple):
    """Packs the parameters of all feedback effects of a model; ``fastest_per_s``: see ``FASTEST``, 0 if unknown."""

    friction: Array
    spring: Array
    cogging: Array
    thresholds: Array
    memory: Array
    fastest_per_s: float = 0.0


def fastest_of(forces: Sequence[Force]) -> float:
    """Return the largest of the rates with which forces were fitted (1/s), 0 if none states it."""
    return max((f.settings[FASTEST][0] for f in forces if FASTEST in f.settings), default=0.0)


def pack(forces: Sequence[Force]) -> Rows:
    """Sum the placed effects, each by its own ``fill`` of the packed rows."""
    friction, spring, cogging = np.zeros(FRICTION), np.zeros(SPRING), np.zeros(COGGING)
    thresholds: list[Array] = []
    memory: list[Array] = []
    for f in forces:
        fill = f.effect.fill
        assert fill is not None
        rows = fill(f.q, f.weights, f.settings)
        for name, row in rows.items():
            match name:
                case "friction":
                    speed = max(friction[3], row[3])
                    friction += row
                    friction[3] = speed
                case "spring":
                    spring += row
                case "cogging":
                    period = row[0] or cogging[0]
                    cogging += row
                    cogging[0] = period
                case "thresholds":
                    thresholds.append(row)
                case _:
                    memory.append(row)
    empty = np.zeros(0)
    return Rows(
        friction,
        spring,
        cogging,
        np.concatenate(thresholds) if thresholds else empty,
        np.concatenate(memory) if memory else empty,
        fastest_of(forces),
    )


class Body(NamedTuple):
    """Holds a linear plant, discretised, whose position and velocity forces depend on."""

    ad: Array
    """Transition (s, s) over a step; ``g0`` and ``g1`` (s,) belong to it (``linear.Discrete``)."""
    g0: Array
    g1: Array
    position: Array
    """Row (s,) of the position."""
    velocity: Array
    """Row (s,) of the velocity."""
    held: bool
    """True if the input is held between its samples, False if it runs straight."""
    sub: int
    """Number of steps per sample."""
    step_s: float
    dry: bool
    """True if dry friction can hold the body."""


@kernel
def speed_after(v, free, gain, friction):
    """Return the speed after a step from speed ``v`` that would end at ``free`` without dry friction.

    ``gain``: change of the speed per unit of a force. Friction acts against the speed at the begin of the step. Where
    the body turns within it, it rests while all else changes its speed by less than friction can, or the rest of the
    step is slip the other way (Karnopp, J. Dyn. Syst. Meas. Control 107, 1985, 100, without his band).
    """
    sign = 1.0 if v > 0.0 or (v == 0.0 and free > 0.0) else -1.0
    slipped = free - sign * max(friction_limit(v, sign, friction, 0), 0.0) * gain
    if slipped * sign >= 0.0:
        return slipped
    push = free - v
    sign = 1.0 if push > 0.0 else -1.0
    over = abs(push) - max(friction_limit(0.0, sign, friction, 0), 0.0) * gain
    return sign * over * slipped / (slipped - v) if over > 0.0 else 0.0


@kernel
def run_feedback(body, rows, u, x0, starts, stop):
    """Return states (n, s) of a ``Body`` with forces (``Rows``) added to the input u (n,), from x0 (starts, s).

    The linear part is exact over a step. Smooth forces and memory vary linearly over
    the step, predicted and corrected once (second order). Dry friction is set-valued (``speed_after``). With bristles
    (``friction[5]`` > 0) it is the LuGre model, its state exact at the mean speed of a step. ``stop`` (starts,) ends
    each stretch early (the rest keeps the last state).
    """
    ad, g0, g1, cp, cv, held, sub, step_s, dry = body
    friction, spring, cogging, thresholds, memory, _ = rows
    n, s = u.size, ad.shape[0]
    out = np.zeros((n, s))
    x = np.zeros(s)
    z = np.zeros(s)
    free = np.zeros(s)
    e = np.empty(thresholds.size)
    gv = 0.0
    for i in range(s):
        gv += cv[i] * (g0[i] + g1[i])
    # a plant of modes is block-diagonal
    first = np.zeros(s, np.int64)
    last = np.zeros(s, np.int64)
    for i in range(s):
        for j in range(s):
            if ad[i, j] != 0.0:
                if last[i] == 0:
                    first[i] = j
                last[i] = j + 1
    any_smooth = np.any(spring != 0.0) or np.any(cogging != 0.0) or friction[4] != 0.0
    stiff = friction[5]
    bristle = 0.0
    bent = 0.0
    at = 0
    end = n
    for k in range(n):
        if at < starts.size and k == starts[at]:
            p = 0.0
            for i in range(s):
                x[i] = x0[at, i]
                p += cp[i] * x[i]
            for j in range(e.size):
                e[j] = p
            bristle = 0.0
            end = stop[at]
            at += 1
        elif k < end:
            ua = u[k - 1]
            du = 0.0 if held else (u[k] - ua) / sub
            for m in range(sub):
                w0 = ua + m * du
                w1 = w0 if held else w0 + du
                p = 0.0
                v = 0.0
                for i in range(s):
                    p += cp[i] * x[i]
                    v += cv[i] * x[i]
                    # the motion without forces is the same in every pass
                    a = g0[i] * w0 + g1[i] * w1
                    for j in range(first[i], last[i]):
                        a += ad[i, j] * x[j]
                    free[i] = a
                f0 = 0.0
                if any_smooth:
                    f0 = smooth_force(p, v, spring, cogging, friction, 0)
                for j in range(e.size):
                    r = thresholds[j]
                    if e[j] < p - r:
                        e[j] = p - r
                    elif e[j] > p + r:
                        e[j] = p + r
                    f0 -= memory[j] * (p - e[j])
                f0 -= stiff * bristle
                f1 = f0
                passes = 2 if any_smooth or e.size > 0 or stiff > 0.0 else 1
                for turn in range(passes):
                    for i in range(s):
                        z[i] = free[i] + g0[i] * f0 + g1[i] * f1
                    if turn + 1 < passes:
                        pn = 0.0
                        vn = 0.0
                        for i in range(s):
                            pn += cp[i] * z[i]
                            vn += cv[i] * z[i]
                        f1 = 0.0
                        if any_smooth:
                            f1 = smooth_force(pn, vn, spring, cogging, friction, 0)
                        for j in range(e.size):
                            r = thresholds[j]
                            f1 -= memory[j] * min(max(pn - e[j], -r), r)
                        if stiff > 0.0:
                            bent = bristle_after(bristle, 0.5 * (v + vn), step_s, friction, 0)
                            f1 -= stiff * bent
                if stiff > 0.0:
                    vn = 0.0
                    for i in range(s):
                        vn += cv[i] * z[i]
                    bristle = bristle_after(bristle, 0.5 * (v + vn), step_s, friction, 0)
                if dry:
                    vn = 0.0
                    for i in range(s):
                        vn += cv[i] * z[i]
                    f = (speed_after(v, vn, gv, friction) - vn) / gv
                    for i in range(s):
                        z[i] += (g0[i] + g1[i]) * f
                for i in range(s):
                    x[i] = z[i]
        for i in range(s):
            out[k, i] = x[i]
    return out
