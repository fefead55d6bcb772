"""The synthetic hand, compiled: sums of processes whose first and second derivatives are known exactly.

The kernel makes one node per millisecond (coordinates, first and second derivatives); ``between`` runs a polynomial of
fifth degree from node to node, so that position, velocity and acceleration belong together at every instant.
"""

from __future__ import annotations

import math

import numpy as np

from hal.compiled import kernel

SOURCES = 6
"""Complex tremor envelopes; processes 0..11 are their real and imaginary parts."""
GAIN, FREQUENCY, DRIFT, UNSTEADY = 12, 13, 14, 17
PROCESSES = 20

HAND = np.dtype(
    [
        ("step_s", "f8"),
        ("transition", "f8", (PROCESSES, 3, 3)),
        ("drive", "f8", (PROCESSES, 3)),
        ("integral", "f8", (3,)),
        ("integral_drive", "f8"),
        ("frequency_hz", "f8"),
        ("wander_hz", "f8"),
        ("depth", "f8"),
        ("tremor", "f8", (SOURCES, SOURCES)),  # sources -> tip (world, m) and body angles (rad)
        ("drift_m", "f8"),
        ("unsteadiness_m", "f8"),
    ]
)
HAND_STATE = np.dtype(
    [
        ("step", "i8"),
        ("x", "f8", (PROCESSES, 3)),
        ("phase", "f8"),
        ("reach", "i8"),
        ("jerk", "i8"),
    ]
)


@kernel
def reach_motion(t, reaches, k, out, intended):
    """Adds reach ``k`` at ``t``: row = start, duration, 6 x from, 6 x to. Minimum jerk (Flash and Hogan 1985)."""
    duration = reaches[k, 1]
    s = (t - reaches[k, 0]) / duration
    if s <= 0.0:
        b, db, ddb = 0.0, 0.0, 0.0
    elif s >= 1.0:
        b, db, ddb = 1.0, 0.0, 0.0
    else:
        b = s * s * s * (10.0 + s * (6.0 * s - 15.0))
        db = 30.0 * s * s * (1.0 - s) * (1.0 - s) / duration
        ddb = 60.0 * s * (1.0 - s) * (1.0 - 2.0 * s) / (duration * duration)
    for c in range(6):
        way = reaches[k, 8 + c] - reaches[k, 2 + c]
        p = reaches[k, 2 + c] + b * way
        out[c] += p
        out[6 + c] += db * way
        out[12 + c] += ddb * way
        if c < 3:
            intended[c] = p


@kernel
def jerk_motion(t, jerks, k, out):
    """Adds jerk ``k``: row = start, time constant, 3 x peak. Shape (s/3)^3 exp(3 - s), s = t/tau: peak 1 at s = 3."""
    tau = jerks[k, 1]
    s = (t - jerks[k, 0]) / tau
    if s <= 0.0 or s > 60.0:
        return
    e = math.exp(3.0 - s) / 27.0
    b = s * s * s * e
    db = s * s * (3.0 - s) * e / tau
    ddb = s * (6.0 - 6.0 * s + s * s) * e / (tau * tau)
    for c in range(3):
        out[c] += b * jerks[k, 2 + c]
        out[6 + c] += db * jerks[k, 2 + c]
        out[12 + c] += ddb * jerks[k, 2 + c]


@kernel
def hand_pose(p, s, reaches, jerks, pose, parts):
    """Pose at the present instant: 6 coordinates, 6 first, 6 second derivatives. ``parts``: intended, tremor (m)."""
    t = s["step"] * p["step_s"]
    pose[:] = 0.0
    k = s["reach"]
    while k + 1 < reaches.shape[0] and t >= reaches[k + 1, 0]:
        k += 1
    s["reach"] = k
    reach_motion(t, reaches, k, pose, parts)
    k = s["jerk"]
    while k + 1 < jerks.shape[0] and t >= jerks[k + 1, 0]:
        k += 1
    s["jerk"] = k
    jerk_motion(t, jerks, k, pose)

    x = s["x"]
    for c in range(3):
        for d in range(3):
            pose[6 * d + c] += p["drift_m"] * x[DRIFT + c, d] + p["unsteadiness_m"] * x[UNSTEADY + c, d]

    # slow common gain g = exp(depth m - depth^2): E[g^2] = 1
    depth = p["depth"]
    g = math.exp(depth * x[GAIN, 0] - depth * depth)
    dg = depth * x[GAIN, 1] * g
    ddg = depth * x[GAIN, 2] * g + depth * x[GAIN, 1] * dg
    w = 2.0 * math.pi * (p["frequency_hz"] + p["wander_hz"] * x[FREQUENCY, 0])
    dw = 2.0 * math.pi * p["wander_hz"] * x[FREQUENCY, 1]
    co, si = math.cos(s["phase"]), math.sin(s["phase"])
    parts[3:6] = 0.0
    matrix = p["tremor"]
    for n in range(SOURCES):
        a, da, dda = x[2 * n, 0], x[2 * n, 1], x[2 * n, 2]
        b, db, ddb = x[2 * n + 1, 0], x[2 * n + 1, 1], x[2 * n + 1, 2]
        dda = g * dda + 2.0 * dg * da + ddg * a
        da = g * da + dg * a
        a = g * a
        ddb = g * ddb + 2.0 * dg * db + ddg * b
        db = g * db + dg * b
        b = g * b
        # y = Re[(a + i b) e^{i phase}], phase' = w
        y = a * co - b * si
        dy = (da - w * b) * co - (db + w * a) * si
        ddy = (dda - 2.0 * w * db - dw * b - w * w * a) * co - (ddb + 2.0 * w * da + dw * a - w * w * b) * si
        for c in range(6):
            m = matrix[c, n]
            pose[c] += m * y
            pose[6 + c] += m * dy
            pose[12 + c] += m * ddy
            if c < 3:
                parts[3 + c] += m * y


@kernel
def hand_nodes(p, s, noise, plan, pose, parts):
    """Fill the next n nodes: ``pose`` (n, 18), ``parts`` (n, 6). ``plan``: reaches and jerks.

    ``noise`` (n, PROCESSES) standard normal, held from node to node. ``p``, ``s``: one-row structured arrays HAND,
    HAND_STATE; ``s`` moves on.
    """
    par, state = p[0], s[0]
    reaches, jerks = plan
    a, b, x = par["transition"], par["drive"], state["x"]
    two_pi = 2.0 * math.pi
    for j in range(pose.shape[0]):
        integral = par["integral_drive"] * noise[j, FREQUENCY]
        for d in range(3):
            integral += par["integral"][d] * x[FREQUENCY, d]
        phase = state["phase"] + two_pi * (par["frequency_hz"] * par["step_s"] + par["wander_hz"] * integral)
        state["phase"] = phase - two_pi * math.floor(phase / two_pi)
        for n in range(PROCESSES):
            x0, x1, x2 = x[n, 0], x[n, 1], x[n, 2]
            for d in range(3):
                x[n, d] = a[n, d, 0] * x0 + a[n, d, 1] * x1 + a[n, d, 2] * x2 + b[n, d] * noise[j, n]
        state["step"] += 1
        hand_pose(par, state, reaches, jerks, pose[j], parts[j])


@kernel
def between(node0, node1, span, coefficients):
    """``coefficients`` (6, 6) of the quintics that join two nodes ``span`` seconds apart: one row per coordinate."""
    for c in range(6):
        p0, v0, a0 = node0[c], node0[6 + c] * span, node0[12 + c] * span * span
        p1, v1, a1 = node1[c], node1[6 + c] * span, node1[12 + c] * span * span
        dp = p1 - p0 - v0 - 0.5 * a0
        dv = v1 - v0 - a0
        da = a1 - a0
        coefficients[c, 0] = p0
        coefficients[c, 1] = v0
        coefficients[c, 2] = 0.5 * a0
        coefficients[c, 3] = 10.0 * dp - 4.0 * dv + 0.5 * da
        coefficients[c, 4] = -15.0 * dp + 7.0 * dv - da
        coefficients[c, 5] = 6.0 * dp - 3.0 * dv + 0.5 * da


@kernel
def pose_between(coefficients, s, span, pose):
    """Fill ``pose`` (18,) at the fraction ``s`` (0..1) between two nodes."""
    for c in range(6):
        k0, k1, k2 = coefficients[c, 0], coefficients[c, 1], coefficients[c, 2]
        k3, k4, k5 = coefficients[c, 3], coefficients[c, 4], coefficients[c, 5]
        pose[c] = k0 + s * (k1 + s * (k2 + s * (k3 + s * (k4 + s * k5))))
        pose[6 + c] = (k1 + s * (2.0 * k2 + s * (3.0 * k3 + s * (4.0 * k4 + s * 5.0 * k5)))) / span
        pose[12 + c] = (2.0 * k2 + s * (6.0 * k3 + s * (12.0 * k4 + s * 20.0 * k5))) / (span * span)
