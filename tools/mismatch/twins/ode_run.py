"""Free runs of differential equations with forces and flows inside, in fixed steps."""

from __future__ import annotations

import numpy as np

from hal.compiled import kernel
from sim_devices.physics.forces import bristle_after, flow_of, friction_limit, smooth_force
from tools.mismatch.twins.program import run_program

SWAY = 4  # columns of a varying parameter: its register, the register that it follows, the strength, the centre


@kernel
def rates_of(operations, registers, first, results, sway, x, u, t, dx):
    """Derivatives ``dx`` (s,) of the states ``x`` (s,) at the inputs ``u`` (m,), without forces.

    Registers: time, states, inputs (and recorded signals), parameters. ``sway`` (k, 4): parameters that follow a state
    or a signal: p (1 + strength (value - centre)).
    """
    s, m = x.size, u.size
    registers[0] = t
    for i in range(s):
        registers[1 + i] = x[i]
    for i in range(m):
        registers[1 + s + i] = u[i]
    for k in range(sway.shape[0]):
        at = int(sway[k, 0])
        first[k] = registers[at]
        registers[at] = registers[at] * (1.0 + sway[k, 2] * (registers[int(sway[k, 1])] - sway[k, 3]))
    run_program(operations, registers)
    for k in range(sway.shape[0] - 1, -1, -1):
        registers[int(sway[k, 0])] = first[k]
    for i in range(s):
        dx[i] = registers[results[i]]


@kernel
def add_forces(x, dx, place, friction, spring, cogging, counts, thresholds, memory, played, bristle, mode, h, flows):
    """Add forces and flows to the derivatives ``dx`` of the states ``x``.

    ``place`` (p, 4): states that hold position and velocity, whose derivative the force is added to, and whether any
    force there is smooth. ``mode`` (p,): direction of slip (+1, -1), 2 at rest, 0 without dry friction. ``h``: seconds
    since the bristles ``bristle`` (p, 2: deflection, velocity) were as they are.
    """
    for k in range(flows.shape[0]):
        dx[int(flows[k, 2])] += flow_of(x[int(flows[k, 1])], flows[k])
    at = 0
    for k in range(place.shape[0]):
        f = 0.0
        if place[k, 3] != 0:
            f += smooth_force(x[place[k, 0]], x[place[k, 1]], spring[k], cogging[k], friction[k])
        if counts[k] > 0:
            p = x[place[k, 0]]
            for j in range(at, at + counts[k]):
                f -= memory[j] * min(max(p - played[j], -thresholds[j]), thresholds[j])
            at += counts[k]
        if friction[k, 5] > 0.0:
            v = 0.5 * (bristle[k, 1] + x[place[k, 1]])
            f -= friction[k, 5] * bristle_after(bristle[k, 0], v, h, friction[k])
        dx[place[k, 2]] += f
    for k in range(place.shape[0]):
        if mode[k] == 2:
            dx[place[k, 1]] = 0.0
        elif mode[k] != 0:
            sign = 1.0 if mode[k] > 0 else -1.0
            limit = friction[k, 0] + sign * friction[k, 1]
            if friction[k, 2] != 0.0:
                limit = friction_limit(x[place[k, 1]], sign, friction[k])
            dx[place[k, 2]] -= sign * max(limit, 0.0)


@kernel
def run_equations(
    operations, registers0, results, sway, x0, starts, stop, u, held, times, step_s, sub,
    place, friction, spring, cogging, counts, thresholds, memory, flows, lowest, highest,
):  # fmt: skip
    """States (n, s) in free run from ``x0`` (starts, s): Runge-Kutta steps of fourth order, ``sub`` to a sample.

    Between samples the inputs ``u`` (n, m) run straight, or are ``held`` (m,). Dry friction is set-valued: within a
    step the direction of slip is fixed; where the velocity crosses zero the body rests while the other forces are
    within the limit, else the rest of the step is slip the other way (Karnopp, J. Dyn. Syst. Meas. Control 107, 1985,
    100, without his band). States stay within ``lowest`` and ``highest`` (s,). ``stop`` (starts,) ends a stretch.
    ``times`` (n,): seconds of each sample.
    """
    n, m = u.shape
    s = x0.shape[1]
    places = place.shape[0]
    out = np.zeros((n, s))
    registers = registers0.copy()
    first = np.zeros(max(sway.shape[0], 1))
    x, z, ua, ub = np.zeros(s), np.zeros(s), np.zeros(m), np.zeros(m)
    k1, k2, k3, k4, rest = np.zeros(s), np.zeros(s), np.zeros(s), np.zeros(s), np.zeros(s)
    played = np.zeros(thresholds.size)
    bristle = np.zeros((places, 2))
    mode = np.zeros(places, np.int64)
    none = np.zeros(places, np.int64)
    dry = np.zeros(places, np.bool_)
    any_dry = False
    pushed = places > 0 or flows.shape[0] > 0
    for k in range(places):
        dry[k] = (friction[k, 0] != 0.0 or friction[k, 1] != 0.0 or friction[k, 2] != 0.0) and friction[k, 5] <= 0.0
        any_dry = any_dry or dry[k]
    h = step_s / sub
    at = 0
    end = n
    for k in range(n):
        if at < starts.size and k == starts[at]:
            for i in range(s):
                x[i] = x0[at, i]
            j = 0
            for q in range(places):
                bristle[q, 0] = 0.0
                for _ in range(counts[q]):
                    played[j] = x[place[q, 0]]
                    j += 1
            end = stop[at]
            at += 1
        elif k < end:
            for step in range(sub):
                t = times[k] - step_s + step * h
                a, b, c = step / sub, (step + 0.5) / sub, (step + 1.0) / sub
                if any_dry:
                    for i in range(m):
                        ua[i] = u[k - 1, i] + (0.0 if held[i] else a * (u[k, i] - u[k - 1, i]))
                    for q in range(places):
                        mode[q] = 0
                        if dry[q]:
                            v = x[place[q, 1]]
                            mode[q] = 1 if v > 0.0 else -1
                            if v == 0.0:
                                rates_of(operations, registers, first, results, sway, x, ua, t, rest)
                                add_forces(x, rest, place, friction, spring, cogging, counts, thresholds, memory,
                                           played, bristle, none, 0.0, flows)  # fmt: skip
                                push = rest[place[q, 2]]
                                sign = 1.0 if push > 0.0 else -1.0
                                mode[q] = 2 if abs(push) <= friction_limit(0.0, sign, friction[q]) else int(sign)
                for q in range(places):
                    bristle[q, 1] = x[place[q, 1]]
                for turn in range(4):
                    share = a if turn == 0 else (c if turn == 3 else b)
                    part = 0.0 if turn == 0 else (h if turn == 3 else 0.5 * h)
                    for i in range(m):
                        ub[i] = u[k - 1, i] + (0.0 if held[i] else share * (u[k, i] - u[k - 1, i]))
                    for i in range(s):
                        slope = 0.0 if turn == 0 else (k1[i] if turn == 1 else (k2[i] if turn == 2 else k3[i]))
                        z[i] = x[i] + part * slope
                    rates = k1 if turn == 0 else (k2 if turn == 1 else (k3 if turn == 2 else k4))
                    rates_of(operations, registers, first, results, sway, z, ub, t + part, rates)
                    if pushed:
                        add_forces(z, rates, place, friction, spring, cogging, counts, thresholds, memory, played,
                                   bristle, mode, part, flows)  # fmt: skip
                for i in range(s):
                    z[i] = x[i] + h / 6.0 * (k1[i] + 2.0 * k2[i] + 2.0 * k3[i] + k4[i])
                j = 0
                for q in range(places):
                    v, vn = x[place[q, 1]], z[place[q, 1]]
                    if friction[q, 5] > 0.0:
                        bristle[q, 0] = bristle_after(bristle[q, 0], 0.5 * (v + vn), h, friction[q])
                    if mode[q] == 2:
                        # at rest when the step began; what exceeds the limit at its end has grown from zero on the way
                        z[place[q, 1]] = 0.0
                        began = rest[place[q, 2]]
                        rates_of(operations, registers, first, results, sway, z, ub, t + h, k1)
                        add_forces(z, k1, place, friction, spring, cogging, counts, thresholds, memory, played,
                                   bristle, none, 0.0, flows)  # fmt: skip
                        push = k1[place[q, 2]]
                        sign = 1.0 if push > 0.0 else -1.0
                        over = abs(push) - friction_limit(0.0, sign, friction[q])
                        if over > 0.0 and push != began:
                            z[place[q, 1]] = sign * 0.5 * over * h * min(over / abs(push - began), 1.0)
                    elif mode[q] != 0 and vn * mode[q] < 0.0:
                        # the velocity crossed zero: at rest, or on the other side with what is left of the step
                        crossed = v / (v - vn) if v != vn else 1.0
                        for i in range(s):
                            rest[i] = x[i] + crossed * (z[i] - x[i])
                        rest[place[q, 1]] = 0.0
                        rates_of(operations, registers, first, results, sway, rest, ub, t + h, k1)
                        add_forces(rest, k1, place, friction, spring, cogging, counts, thresholds, memory, played,
                                   bristle, none, 0.0, flows)  # fmt: skip
                        push = k1[place[q, 2]]
                        sign = 1.0 if push > 0.0 else -1.0
                        over = abs(push) - friction_limit(0.0, sign, friction[q])
                        z[place[q, 1]] = sign * over * (1.0 - crossed) * h if over > 0.0 else 0.0
                    p = z[place[q, 0]]
                    for _ in range(counts[q]):
                        played[j] = min(max(played[j], p - thresholds[j]), p + thresholds[j])
                        j += 1
                for i in range(s):
                    x[i] = min(max(z[i], lowest[i]), highest[i])
        for i in range(s):
            out[k, i] = x[i]
    return out


@kernel
def run_readings(operations, registers0, results, x, u, t):
    """Outputs (n, q) for states (n, s), inputs (n, m) and times (n,)."""
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
        run_program(operations, registers)
        for j in range(results.size):
            out[k, j] = registers[results[j]]
    return out
