"""Forces inside an equation of motion, as scalar compiled functions: friction, spring, cogging, memory.

One packed row of numbers per family, so that one compiled loop serves every combination; a row of zeros is
"absent". The effects of ``friction.py`` and ``spring.py`` fill the rows; twins integrate them.
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from hal.compiled import kernel
from sim_devices.physics.effect import Array, Context

FRICTION = 8
"""Level, level difference, breakaway extra, Stribeck speed, viscous difference, bristle stiffness, lean of a loop, and
1 if the extra falls with the exponential of the speed, 0 if with that of its square."""
# cubic, quadratic, linear, quintic, drag, damping with amplitude, stop stiffness, half gap, centre, constant force,
# damping
SPRING = 11
UNCENTRED = "uncentred"  # fact of a twin: its position counts from where the record begins, and nothing centres it
OFFSET = "offset"  # fact of a twin: a constant force is a parameter of its own, or moves the zero of its output alone
COGGING = 7  # period, sin1, cos1, sin2, cos2; sine and cosine of the angle itself (gravity)
FLOW = 5  # law, state it depends on, state whose derivative it is added to, strength, level
ROOT, ABOVE, CONVECTION, RADIATION_K, RADIATION_C = range(5)  # laws of a flow
ZERO_C = -273.15


def packed(family: str, size: int, at: Mapping[int, float]) -> dict[str, Array]:
    """Return the row of a family, ``size`` numbers, that is zero but for the numbers ``at`` their places."""
    row = np.zeros(size)
    row[list(at)] = list(at.values())
    return {family: row}


@kernel
def friction_limit(v, sign, row, at):
    """Return the largest friction at speed v in the direction ``sign``: Coulomb, its asymmetry, Stribeck's extra.

    F = Fc + sign dF + Fs exp(-(v/vs)^2); Armstrong-Helouvry, Control of Machines with Friction (1991), eq. 2.3. With
    ``row[at + 7]`` = 1 the extra is Fs exp(-|v|/vs) (A. Tustin, J. IEE 94 IIA (1947) 143), with 2 Fs / (1 + (v/vs)^2)
    (D. P. Hess, A. Soom, J. Tribology 112 (1990) 147).
    The numbers of the family begin at ``row[at]``.
    """
    f = row[at] + sign * row[at + 1]
    if row[at + 2] != 0.0 and row[at + 3] > 0.0:
        r = abs(v) / row[at + 3]
        if row[at + 7] == 2.0:
            f += row[at + 2] / (1.0 + r * r)
        else:
            f += row[at + 2] * np.exp(-r if row[at + 7] == 1.0 else -r * r)
    return f


@kernel
def bristle_after(z, v, step_s, row, at):
    """Return the bristle deflection after ``step_s`` at constant speed v, exactly: z' = v - sigma |v| z / g(v).

    C. Canudas de Wit, H. Olsson, K. J. Astrom, P. Lischinsky, IEEE Trans. AC 40 (1995) 419, eqs. 3-4; g is
    ``friction_limit`` and sigma ``row[at + 5]``. With a lean (``row[at + 6]``) they are those of ``loop_after``.
    """
    if v == 0.0:
        return z
    if row[at + 6] != 0.0:
        return loop_after(z, v * step_s, row[at] / row[at + 5], row[at + 6])
    sign = 1.0 if v > 0.0 else -1.0
    limit = friction_limit(v, sign, row, at)
    if limit <= 0.0:
        return 0.0
    settled = sign * limit / row[at + 5]
    return settled + (z - settled) * np.exp(-row[at + 5] * abs(v) * step_s / limit)


@kernel
def loop_after(z, move, yielding, lean):
    """Return the deflection of a Bouc-Wen element after a ``move``: z' = v - (|v| z + lean v |z|) / yielding.

    Y. K. Wen, J. Eng. Mech. 102 (1976) 249, eq. 3 with n = 1, beta = 1 / yielding, gamma = lean beta. Exact: it relaxes
    at one rate towards zero and at another away from it. With lean < -1 it stiffens as it is loaded.
    """
    if move == 0.0 or yielding <= 0.0:
        return z
    sign = 1.0 if move > 0.0 else -1.0
    left = abs(move)
    w = sign * z
    if w < 0.0:
        # back to rest first: w' = 1 - b w with the rate b of unloading
        b = (1.0 - lean) / yielding
        back = -w if b == 0.0 else np.log1p(-b * w) / b
        if back >= left:
            return sign * (w * np.exp(-b * left) - (np.expm1(-b * left) / b if b != 0.0 else -left))
        left -= back
        w = 0.0
    a = (1.0 + lean) / yielding
    # a loop that stiffens without end has left what a recording shows
    grow = max(-a * left, -700.0) if a > 0.0 else min(-a * left, 50.0)
    return sign * (w * np.exp(grow) - (np.expm1(grow) / a if a != 0.0 else -left))


@kernel
def loop_along(x, yielding, lean, starts):
    """Return the deflection (n,) of a Bouc-Wen element along the course x (n,), at rest at each start."""
    out = np.zeros(x.size)
    at = 0
    for k in range(x.size):
        if at < starts.size and k == starts[at]:
            at += 1
        elif k > 0:
            out[k] = loop_after(out[k - 1], x[k] - x[k - 1], yielding, lean)
    return out


@kernel
def smooth_force(p, v, spring, cogging, friction, place):
    """Return the force continuous in position p and velocity v: spring curvature, drag, stops, cogging, gravity.

    The rows of all places are concatenated; ``place`` is the index of the row.
    """
    k, c = place * SPRING, place * COGGING
    q = p * p
    f = -(spring[k] + spring[k + 3] * q) * q * p - spring[k + 1] * q - spring[k + 2] * p
    f += spring[k + 9] - friction[place * FRICTION + 4] * abs(v)
    f -= (spring[k + 4] * abs(v) + spring[k + 5] * q + spring[k + 10]) * v
    if spring[k + 6] != 0.0:
        d = p - spring[k + 8]
        f -= spring[k + 6] * (d - min(max(d, -spring[k + 7]), spring[k + 7]))
    if cogging[c] > 0.0:
        a = 2.0 * np.pi * p / cogging[c]
        f += cogging[c + 1] * np.sin(a) + cogging[c + 2] * np.cos(a)
        f += cogging[c + 3] * np.sin(2.0 * a) + cogging[c + 4] * np.cos(2.0 * a)
    if cogging[c + 5] != 0.0 or cogging[c + 6] != 0.0:
        f += cogging[c + 5] * np.sin(p) + cogging[c + 6] * np.cos(p)
    return f


@kernel
def flow_of(x, law, strength, level):
    """Return the flow for a state x by ``law`` of what x is above a level: its root, itself, its power 1.25, or the
    difference of their fourth powers as absolute temperatures (in K or degC)."""
    over = x - level
    if law == 2.0:
        return strength * over * abs(over) ** 0.25
    if law >= 3.0:
        zero = 0.0 if law == 3.0 else ZERO_C
        return strength * (max(x - zero, 0.0) ** 4 - max(level - zero, 0.0) ** 4)
    if over <= 0.0:
        return 0.0
    return strength * (np.sqrt(over) if law == 0.0 else over)


def base_moves(x: Array, ctx: Context) -> list[Array]:
    """Return the first-order changes (n,) of an output when the parameters of its equation of motion change.

    The parameters are offset, spring, drag and inertia. A fit that lacks a force biases them, and the residual then
    holds these changes besides that force. ``x`` (n,) is the recorded position.
    """
    drives = [ctx.signals[s] for s in ("force", "torque") if s in ctx.signals]
    inside = (np.ones(x.size), x, np.gradient(x, ctx.dt), *drives)
    return [ctx.to_output(np.ascontiguousarray(c)) for c in inside]
