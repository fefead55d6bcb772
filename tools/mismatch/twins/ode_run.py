"""Integrates differential equations with forces and flows inside, in free run and fixed steps."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from hal.compiled import kernel
from sim_devices.physics.effect import Array
from sim_devices.physics.forces import COGGING, FRICTION, SPRING, bristle_after, flow_of, friction_limit, smooth_force
from sim_devices.physics.parameter import BY_LOG, OWN_SIGN, RATE_SIGN
from tools.mismatch.twins.native import run_code

SWAY = 6
"""Number of columns of a varying parameter: its register, the register that it follows, strength, centre, and in place
of the value the sign of that state's derivative at the constant parameters (1) or of the state itself (2), or a law for
its logarithm (3), and the strength of the square in that."""

MOST_LOG = 50.0
"""Largest logarithm of the factor of a parameter: a trial of the search must stay finite."""

STEEP = 0.25
"""Fall of friction with speed, times a step, above which the step is taken in parts; and the change of a bristle's
force, as a share of its limit."""

JOINT = 8 + SPRING
"""Number of columns of a joint: position, velocity and target of both sides, the ratio b of its travel x_1 - b x_2, the
change of the second derivative per change of the first, and the spring (``forces.SPRING``)."""


class Drive(NamedTuple):
    """Holds the inputs of a run of equations and the stretches in which it runs free."""

    u: Array
    """Inputs (n, m). Between samples they run straight, or are held where ``held`` (m,) is set."""
    held: NDArray[np.bool_]
    times: Array
    """Seconds (n,) of each sample."""
    step_s: float
    sub: int
    """Number of steps per sample."""
    fine: int
    """Number of parts of a step in which a body may stick, slip or turn."""
    starts: NDArray[np.int64]
    """First sample of each stretch."""
    stop: NDArray[np.int64]
    """Sample behind the last one of each stretch."""


class Packed(NamedTuple):
    """Holds the forces, flows and varying parameters of a run, those of all places one behind the other."""

    place: NDArray[np.int64]
    """See ``equations.Inside``."""
    friction: Array
    spring: Array
    cogging: Array
    counts: NDArray[np.int64]
    """Number of thresholds of each place."""
    thresholds: Array
    memory: Array
    flows: Array
    sway: Array
    """Parameters (k, SWAY) that follow a signal, a state or a direction; see ``varied``."""
    joints: Array
    """Smooth forces (k, JOINT) between two bodies."""


@kernel
def varied(value, sway, c):
    """Return the factor of a parameter at the ``value`` of what it follows: 1 + a d, d = value - centre, or of a state
    exp(a d + b d^2)."""
    d = value - sway[c, 3]
    return np.exp(min(d * (sway[c, 2] + d * sway[c, 5]), MOST_LOG)) if sway[c, 4] == BY_LOG else 1.0 + d * sway[c, 2]


@kernel
def rates_of(code, x, u):
    """Return the derivatives (s,) of the states ``x`` (s,) at the inputs ``u`` (m,) at time zero, without forces.

    Registers of the program, which change: time, states, inputs (and recorded signals), parameters.
    """
    address, registers, results = code
    s, m = x.size, u.size
    rates = np.empty(s)
    registers[0] = 0.0
    for i in range(s):
        registers[1 + i] = x[i]
    for i in range(m):
        registers[1 + s + i] = u[i]
    run_code(address, registers)
    for i in range(s):
        rates[i] = registers[results[i]]
    return rates


@kernel
def mean_speed(speeds, c):
    """Return the mean over a step of a velocity of which ``speeds[:, c]`` are the values at its stages."""
    return (speeds[0, c] + 2.0 * speeds[1, c] + 2.0 * speeds[2, c] + speeds[3, c]) / 6.0


@kernel
def run_equations(code, drive, packed, x0, limits):
    """Return states (n, s) of a free run from ``x0`` (starts, s) by fourth-order Runge-Kutta.

    ``drive``: a ``Drive``; ``packed``: ``Packed``. States stay within ``limits``, lowest and highest (s,).

    Dry friction is set-valued: within a step the direction of slip is fixed; where the velocity crosses zero the body
    rests while the other forces are within the limit, else the rest of the step is slip the other way (Karnopp, J. Dyn.
    Syst. Meas. Control 107, 1985, 100, without his band). That is of second order only, so that a step in which a body
    begins to slip, or is slow enough to turn, is taken in ``fine`` parts. A bristle bends with the travel since the
    begin of the step, which the stages give as they give a position; a step in which it turns or bends much is taken in
    parts, too.

    The derivative is computed in one place of the loop and not in a function: a call that passes arrays counts
    references to each of them, which costs more than the equations.
    """
    address, registers0, results = code
    u, held, times, step_s, sub, fine, starts, stop = drive
    place, friction, spring, cogging, counts, thresholds, memory, flows, sway, joints = packed
    lowest, highest = limits
    n, m = u.shape
    s = x0.shape[1]
    places = place.shape[0]
    out = np.zeros((n, s))
    registers = registers0.copy()
    first, way = np.zeros(max(sway.shape[0], 1)), np.zeros(max(sway.shape[0], 1))
    no_cogging, no_friction = np.zeros(COGGING), np.zeros(FRICTION)
    turns = np.any(sway[:, 4] == RATE_SIGN)
    # at the begin of a step, where the derivative is asked for, at the end of the step
    x, y, z = np.zeros(s), np.zeros(s), np.zeros(s)
    rates = np.zeros((5, s))  # derivatives of the four stages, and the one that decides between slip and rest
    played = np.zeros(thresholds.size)
    bristle = np.zeros(places)  # deflection at the start of a step
    speeds = np.zeros((4, places))  # velocities at the stages
    pushed = np.zeros(places)  # sum of all other forces at the start of a step
    crossed = np.zeros(places)
    mode = np.zeros(places, np.int64)  # direction of slip (+1, -1), 2 at rest, 0 without dry friction
    dry = np.zeros(places, np.bool_)
    for q in range(places):
        row = q * FRICTION
        has_limit = friction[row] != 0.0 or friction[row + 1] != 0.0 or friction[row + 2] != 0.0
        dry[q] = has_limit and friction[row + 5] <= 0.0
    kept, bent = np.zeros(thresholds.size), np.zeros(places)  # memories at the begin of a whole step
    parts = sub * fine
    at = 0
    end = n
    for k in range(n):
        if at < starts.size and k == starts[at]:
            for i in range(s):
                x[i] = x0[at, i]
            j = 0
            for q in range(places):
                bristle[q] = 0.0
                for _ in range(counts[q]):
                    played[j] = x[place[q, 0]]
                    j += 1
            end = stop[at]
            at += 1
        elif k < end:
            done, until = 0, 0  # parts of the sample that are taken, and up to which parts are taken one by one
            while done < parts:
                width = 1 if done < until or fine == 1 else fine
                h = step_s * width / parts
                t = times[k] - step_s + step_s * done / parts
                is_rough = False
                if width > 1:
                    kept[:] = played
                    bent[:] = bristle
                j = 0
                # four stages, then each place where the step may have ended in rest
                for turn in range(4 + places):
                    if is_rough:
                        break
                    q = turn - 4
                    stage = min(turn, 4)
                    part = 0.0 if turn == 0 else (0.5 * h if turn < 3 else h)
                    if turn < 4:
                        for i in range(s):
                            y[i] = x[i] + (part * rates[turn - 1, i] if turn > 0 else 0.0)
                    else:
                        velocity = place[q, 1]
                        v, vn = x[velocity], z[velocity]
                        row = q * FRICTION
                        if friction[row + 5] > 0.0:
                            bristle[q] = bristle_after(bristle[q], mean_speed(speeds, q), h, friction, row)
                        decided = False
                        if mode[q] == 2:
                            z[velocity] = 0.0
                            for i in range(s):
                                y[i] = z[i]
                        elif mode[q] != 0 and vn * mode[q] < 0.0:
                            crossed[q] = v / (v - vn) if v != vn else 1.0
                            for i in range(s):
                                y[i] = x[i] + crossed[q] * (z[i] - x[i])
                            y[velocity] = 0.0
                        else:
                            decided = True
                        if decided:
                            for _ in range(counts[q]):
                                p = z[place[q, 0]]
                                played[j] = min(max(played[j], p - thresholds[j]), p + thresholds[j])
                                j += 1
                            continue
                    # the derivative at y
                    share = (done + width * part / h) / parts
                    registers[0] = t + part
                    for i in range(s):
                        registers[1 + i] = y[i]
                    for i in range(m):
                        registers[1 + s + i] = u[k - 1, i] + (0.0 if held[i] else share * (u[k, i] - u[k - 1, i]))
                    # twice where a parameter follows the direction in which the equations move without it
                    for last in range(0 if turns else 1, 2):
                        if last == 1:
                            for c in range(sway.shape[0]):
                                r = int(sway[c, 0])
                                first[c] = registers[r]
                                value = registers[int(sway[c, 1])]
                                if sway[c, 4] == RATE_SIGN:
                                    value = way[c]
                                elif sway[c, 4] == OWN_SIGN:
                                    value = np.sign(value)
                                registers[r] *= varied(value, sway, c)
                        run_code(address, registers)
                        if last == 0:
                            for c in range(sway.shape[0]):
                                if sway[c, 4] == RATE_SIGN:
                                    way[c] = np.sign(registers[results[int(sway[c, 1]) - 1]])
                    for c in range(sway.shape[0] - 1, -1, -1):
                        registers[int(sway[c, 0])] = first[c]
                    for i in range(s):
                        rates[stage, i] = registers[results[i]]
                    for c in range(flows.shape[0]):
                        f = flow_of(y[int(flows[c, 1])], flows[c, 0], flows[c, 3], flows[c, 4])
                        rates[stage, int(flows[c, 2])] += f
                    for c in range(joints.shape[0]):
                        b = joints[c, 6]
                        p = y[int(joints[c, 0])] - b * y[int(joints[c, 3])]
                        v = y[int(joints[c, 1])] - b * y[int(joints[c, 4])]
                        f = smooth_force(p, v, joints[c, 8:], no_cogging, no_friction, 0)
                        rates[stage, int(joints[c, 2])] += f
                        rates[stage, int(joints[c, 5])] += joints[c, 7] * f
                    e = 0
                    for c in range(places):
                        p, v, f, row = y[place[c, 0]], y[place[c, 1]], 0.0, c * FRICTION
                        if place[c, 3] != 0:
                            f += smooth_force(p, v, spring, cogging, friction, c)
                        for i in range(e, e + counts[c]):
                            f -= memory[i] * min(max(p - played[i], -thresholds[i]), thresholds[i])
                        e += counts[c]
                        if friction[row + 5] > 0.0:
                            deflection = bristle[c]
                            if turn < 4:
                                speeds[turn, c] = v
                            if 0 < turn < 4:
                                deflection = bristle_after(deflection, speeds[turn - 1, c], part, friction, row)
                            f -= friction[row + 5] * deflection
                        rates[stage, place[c, 2]] += f
                    if turn == 0:
                        for c in range(places):
                            v, pushed[c], mode[c] = x[place[c, 1]], rates[0, place[c, 2]], 0
                            if dry[c]:
                                mode[c] = 1 if v > 0.0 else -1
                                if v == 0.0:
                                    sign = 1.0 if pushed[c] > 0.0 else -1.0
                                    most = friction_limit(0.0, sign, friction, c * FRICTION)
                                    mode[c] = 2 if abs(pushed[c]) <= most else int(sign)
                    if turn < 4:
                        for c in range(places):
                            if mode[c] == 2:
                                rates[turn, place[c, 1]] = 0.0
                            elif mode[c] != 0:
                                sign = 1.0 if mode[c] > 0 else -1.0
                                row = c * FRICTION
                                limit = friction[row] + sign * friction[row + 1]
                                if friction[row + 2] != 0.0:
                                    limit = friction_limit(y[place[c, 1]], sign, friction, row)
                                rates[turn, place[c, 2]] -= sign * max(limit, 0.0)
                        if turn == 3:
                            for i in range(s):
                                f = rates[0, i] + 2.0 * rates[1, i] + 2.0 * rates[2, i] + rates[3, i]
                                z[i] = x[i] + h / 6.0 * f
                            if width > 1:
                                for c in range(places):
                                    row = c * FRICTION
                                    if friction[row + 5] > 0.0:
                                        v, vn = x[place[c, 1]], z[place[c, 1]]
                                        mean = mean_speed(speeds, c)
                                        moved = bristle_after(bristle[c], mean, h, friction, row) - bristle[c]
                                        most = friction_limit(mean, 1.0 if mean > 0.0 else -1.0, friction, row)
                                        if (
                                            vn * np.sign(v) < abs(vn - v)
                                            or abs(moved) * friction[row + 5] > STEEP * most
                                        ):
                                            is_rough = True
                                    if mode[c] == 1 or mode[c] == -1:
                                        v, vn, row = x[place[c, 1]], z[place[c, 1]], c * FRICTION
                                        sign, fall = float(mode[c]), 0.0
                                        if friction[row + 2] != 0.0:
                                            fall = friction_limit(v, sign, friction, row)
                                            fall = abs(fall - friction_limit(vn, sign, friction, row))
                                        if vn * sign < abs(vn - v) or fall * h > STEEP * abs(vn - v):
                                            is_rough = True
                    else:
                        push = rates[4, place[q, 2]]
                        sign = 1.0 if push > 0.0 else -1.0
                        over = abs(push) - friction_limit(0.0, sign, friction, q * FRICTION)
                        vn = 0.0
                        if over > 0.0 and width > 1:
                            is_rough = True
                        if over > 0.0 and mode[q] != 2:
                            # the rest of the step is slip in the other direction
                            vn = sign * over * (1.0 - crossed[q]) * h
                        elif over > 0.0 and push != pushed[q]:
                            # the excess over the limit at the end of the step has grown from zero within it
                            vn = sign * 0.5 * over * h * min(over / abs(push - pushed[q]), 1.0)
                        z[place[q, 1]] = vn
                        p = z[place[q, 0]]
                        for _ in range(counts[q]):
                            played[j] = min(max(played[j], p - thresholds[j]), p + thresholds[j])
                            j += 1
                if is_rough:
                    until = done + width
                    played[:] = kept
                    bristle[:] = bent
                    continue
                done += width
                for i in range(s):
                    x[i] = min(max(z[i], lowest[i]), highest[i])
        for i in range(s):
            out[k, i] = x[i]
    return out


@kernel
def run_readings(code, x, u, t, sway):
    """Return outputs (n, q) for states (n, s), inputs (n, m) and times (n,).

    ``sway`` (k, SWAY) are varying parameters; one that follows a direction is constant here.
    """
    address, registers0, results = code
    n = u.shape[0]
    out = np.empty((n, results.size))
    registers = registers0.copy()
    s, m = x.shape[1], u.shape[1]
    for k in range(n):
        registers[0] = t[k]
        for i in range(s):
            registers[1 + i] = x[k, i]
        for i in range(m):
            registers[1 + s + i] = u[k, i]
        for c in range(sway.shape[0]):
            registers[int(sway[c, 0])] = registers0[int(sway[c, 0])]
        for c in range(sway.shape[0]):
            if sway[c, 4] == 0.0 or sway[c, 4] == BY_LOG:
                registers[int(sway[c, 0])] *= varied(registers[int(sway[c, 1])], sway, c)
        run_code(address, registers)
        for j in range(results.size):
            out[k, j] = registers[results[j]]
    return out
