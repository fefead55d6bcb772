"""Steps the plant in one compiled kernel: hand, body, amplifier, stacks, manipulator, sensors, in steps of 1/8 ms."""

from __future__ import annotations

import math

import numpy as np

from hal.compiled import kernel
from sim_devices.plant.hand_kernel import between, pose_between
from sim_devices.plant.manipulator import take_up, tip_displacement
from sim_devices.plant.rigid_body import attitude, body_rates, quaternion, specific_force
from sim_devices.plant.sensors import ACCELEROMETER, accelerometer_V
from sim_devices.plant.stack import DRIVE, DRIVE_STATE, drive_step

STEPS_PER_MS = 8
STEP_NS = 1_000_000 // STEPS_PER_MS
STEP_S = STEP_NS * 1e-9
NODE_S = 1e-3
NOISES = 17
"""Standard normal numbers per step: 6 accelerometers, 8 DAQ inputs, 3 magnetometer outputs."""
SLOW_NOISES = 2
"""Per millisecond: ambient temperature, supply."""
PAST = 82
"""Accelerometer voltages that are kept: those of 10 ms, and one more on each side."""

TRUTH = (
    ("tip_m", 0, 3),
    ("tip_rigid_m", 3, 3),
    ("intended_m", 6, 3),
    ("tremor_m", 9, 3),
    ("quaternion", 12, 4),
    ("stroke_m", 16, 3),
    ("amplifier_V", 19, 3),
    ("temperature_C", 22, 1),
)
TRUTH_COLUMNS = 23

PLANT = np.dtype(
    [
        ("channel", DRIVE, (3,)),
        ("circle_m", "f8"),
        ("shaft_m", "f8"),
        ("lever", "f8", (3,)),
        ("mount", "f8", (3, 3)),  # manipulator to body
        ("rest_m", "f8", (3,)),  # ball heights at neutral
        ("rest_tip_m", "f8", (3,)),
        ("play_m", "f8"),
        ("frame", "f8", (3, 3)),
        ("arm_m", "f8", (3, 3)),  # sensor locations from the tip, body
        ("gravity", "f8"),
        ("accelerometer", ACCELEROMETER, (6,)),
        ("supply_V", "f8"),
        ("supply_wander_V", "f8"),
        ("supply_keep", "f8"),
        ("divider", "f8"),
        ("temperature_offset_K", "f8"),
        ("ambient_C", "f8"),
        ("ambient_wander_K", "f8"),
        ("ambient_keep", "f8"),
        ("board_lag", "f8"),
        ("warm_up_K", "f8"),
        ("warm_up_s", "f8"),
        ("on_since_s", "f8"),
        ("field_G", "f8", (3,)),
        ("magnetometer", "f8", (3, 3)),
        ("magnetometer_offset_V", "f8", (3,)),
        ("hard_iron_G", "f8", (3,)),
        ("piezo_G_per_A", "f8", (3, 3)),
        ("magnetometer_noise_V", "f8"),
        ("daq_gain", "f8", (8,)),
        ("daq_offset_V", "f8", (8,)),
        ("daq_noise_V", "f8"),
        ("daq_delay_s", "f8"),
        ("sense_s", "f8"),  # between two calls of ``sense``
    ]
)

STATE = np.dtype(
    [
        ("step", "i8"),
        ("demand_V", "f8", (3,)),
        ("demand_fix_V", "f8", (3,)),  # mean over the running step minus demand_V
        ("channel", DRIVE_STATE, (3,)),
        ("quintic", "f8", (6, 6)),
        ("pose", "f8", (18,)),
        ("attitude", "f8", (3, 3)),
        ("rate", "f8", (3,)),
        ("angular_acceleration", "f8", (3,)),
        ("specific_force", "f8", (3, 3)),  # per sensor location, body
        ("ambient_K", "f8"),
        ("board_K", "f8"),  # follows the room's wander
        ("supply_wander_V", "f8"),
        ("temperature_C", "f8"),
        ("supply_V", "f8"),
        ("sensor_V", "f8", (6,)),  # before the RC
        ("rc_V", "f8", (6,)),
        ("past_V", "f8", (PAST, 6)),  # ``rc_V`` of the last steps, in a ring
        ("newest", "i8"),
        ("seat_m", "f8", (3,)),  # tip displacement behind the play of the mount
        ("noise", "f8", (NOISES,)),
        ("clipped", "i8", (6,)),  # steps in which an accelerometer was out of range
        ("strap", "f8"),
        ("daq_V", "f8", (8,)),
        ("magnetometer_V", "f8", (3,)),
    ]
)


@kernel
def copy(a, b):
    """Copy ``a`` to ``b``. A slice assignment would compile half of numba's string library, for its error message."""
    for i in range(b.shape[0]):
        b[i] = a[i]


@kernel
def room(p, s, noise):
    """Temperature of the sensor board and the supply, once per millisecond."""
    keep = p["ambient_keep"]
    s["ambient_K"] = keep * s["ambient_K"] + p["ambient_wander_K"] * math.sqrt(1.0 - keep * keep) * noise[0]
    s["board_K"] += p["board_lag"] * (s["ambient_K"] - s["board_K"])
    keep = p["supply_keep"]
    s["supply_wander_V"] = keep * s["supply_wander_V"] + p["supply_wander_V"] * math.sqrt(1.0 - keep * keep) * noise[1]
    on_s = p["on_since_s"] + s["step"] * STEP_S
    warm = p["warm_up_K"] * (1.0 - math.exp(-on_s / p["warm_up_s"]))
    s["temperature_C"] = p["ambient_C"] + s["board_K"] + warm
    s["supply_V"] = p["supply_V"] + s["supply_wander_V"]


@kernel
def sense(p, s, noise):
    """Attitude at ``s["pose"]`` and accelerometers, one step of their RC filters included."""
    pose, c = s["pose"], s["attitude"]
    omega, alpha, f = s["rate"], s["angular_acceleration"], s["specific_force"]
    attitude(p["frame"], pose[3:6], c)
    body_rates(pose[3:6], pose[9:12], pose[15:18], omega, alpha)
    for i in range(3):
        specific_force((c, pose[12:15], omega, alpha), p["gravity"], p["arm_m"][i], f[i])
    for i in range(6):
        a = p["accelerometer"][i]
        v = accelerometer_V(a, f[a["location"]], s["supply_V"], s["temperature_C"])
        if abs(v - 0.5 * s["supply_V"]) >= a["range_V"] * s["supply_V"] / 5.0 * (1.0 - 1e-12):
            s["clipped"][i] += 1
        hiss = a["noise_V"] * noise[i]
        keep = a["rc_keep"]
        s["rc_V"][i] = keep * s["rc_V"][i] + a["rc_from"] * s["sensor_V"][i] + a["rc_to"] * v + (1.0 - keep) * hiss
        s["sensor_V"][i] = v
    s["newest"] = (s["newest"] + 1) % PAST
    copy(s["rc_V"], s["past_V"][s["newest"]])


@kernel
def past_V(p, s, i, ago_s):
    """Return accelerometer ``i`` behind its RC filter, ``ago_s`` before the last step, in V."""
    steps = ago_s / p["sense_s"]
    whole = int(steps)
    part = steps - whole
    at = s["newest"] - whole
    return (1.0 - part) * s["past_V"][at % PAST, i] + part * s["past_V"][(at - 1) % PAST, i]


@kernel
def outputs(p, s, later_s):
    """Writes the voltages at the connectors, ``later_s`` (less than a step) after the present instant.

    ``s["daq_V"]``: six accelerometers, supply, temperature; ``s["magnetometer_V"]``. Each step has its own noise.
    """
    daq_V, magnetometer_V = s["daq_V"], s["magnetometer_V"]
    noise = s["noise"]
    supply = s["supply_V"]
    for i in range(8):
        if i < 6:
            v = s["rc_V"][i]
            ahead_s = later_s - p["daq_delay_s"]
            if ahead_s > 0.0:
                v = s["sensor_V"][i] + (v - s["sensor_V"][i]) * math.exp(-ahead_s / p["accelerometer"][i]["rc_s"])
            elif ahead_s < 0.0:
                v = past_V(p, s, i, -ahead_s)
        elif i == 6:
            v = supply * p["divider"]
        else:
            v = 0.5 + 0.01 * (s["temperature_C"] + p["temperature_offset_K"])
        daq_V[i] = p["daq_gain"][i] * v + p["daq_offset_V"][i] + p["daq_noise_V"] * noise[6 + i]
    c, b = s["attitude"], p["field_G"]
    field = np.empty(3)
    for i in range(3):
        field[i] = c[0, i] * b[0] + c[1, i] * b[1] + c[2, i] * b[2] + p["hard_iron_G"][i]
        for j in range(3):
            field[i] += p["piezo_G_per_A"][i, j] * s["channel"][j]["current_A"]
    for i in range(3):
        m = p["magnetometer"][i]
        v = s["strap"] * (m[0] * field[0] + m[1] * field[1] + m[2] * field[2]) + p["magnetometer_offset_V"][i]
        magnetometer_V[i] = 2.5 + v + p["magnetometer_noise_V"] * noise[14 + i]


@kernel
def outputs_later(plant, state, later_s):
    """Call ``outputs`` from Python. An array crosses into compiled code a hundred times faster than a record of it."""
    outputs(plant[0], state[0], later_s)


@kernel
def truth_row(p, s, part, row):
    """``row`` (TRUTH_COLUMNS,) of the present instant; ``part`` (6,): intended and tremor part of the tip path."""
    z, d = np.empty(3), np.empty(3)
    for i in range(3):
        stroke = s["channel"][i]["mode"][0]
        z[i] = p["rest_m"][i] + p["lever"][i] * (stroke - p["channel"][i]["reference_m"])
        row[16 + i] = stroke
        row[19 + i] = s["channel"][i]["stack_V"]
    tip_displacement(z, p["circle_m"], p["shaft_m"], d)
    e, m, rest = np.empty(3), p["mount"], p["rest_tip_m"]
    for i in range(3):
        e[i] = m[i, 0] * (d[0] - rest[0]) + m[i, 1] * (d[1] - rest[1]) + m[i, 2] * (d[2] - rest[2])
    take_up(p["play_m"], s["seat_m"], e)
    c = s["attitude"]
    for i in range(3):
        rigid = s["pose"][i]
        row[i] = rigid + c[i, 0] * e[0] + c[i, 1] * e[1] + c[i, 2] * e[2]
        row[3 + i] = rigid
        row[6 + i] = part[i]
        row[9 + i] = part[3 + i]
    quaternion(c, row[12:16])
    row[22] = s["temperature_C"]


@kernel
def begin(plant, state, node, part, truth):
    """Set the first instant of the world, at rest with settled filters, and write the first truth row."""
    p, s = plant[0], state[0]
    room(p, s, np.zeros(SLOW_NOISES))
    copy(node, s["pose"])
    sense(p, s, s["noise"])
    copy(s["sensor_V"], s["rc_V"])
    for k in range(PAST):
        copy(s["rc_V"], s["past_V"][k])
    outputs(p, s, 0.0)
    truth_row(p, s, part, truth)


@kernel
def advance(plant, state, block, steps, truth, row):
    """Run ``steps`` (first, stop) of a block of n milliseconds, without ``stop``. Return the next free row of
    ``truth``.

    ``block``: nodes (n + 1, 18) of the hand, node 0 at the block's start; its parts (n, 6); noise (8 n, NOISES) and
    slow noise (n, SLOW_NOISES), standard normal (or zeros: a noiseless twin). ``plant`` and ``state`` are one-row
    structured arrays PLANT, STATE; ``state`` and ``truth`` are written.
    """
    p, s = plant[0], state[0]
    nodes, parts, noise, slow = block
    first, stop = steps
    for j in range(first, stop):
        ms, k = j // STEPS_PER_MS, j % STEPS_PER_MS
        if k == 0:
            between(nodes[ms], nodes[ms + 1], NODE_S, s["quintic"])
        for i in range(3):
            drive_step(p["channel"][i], s["channel"][i], s["demand_V"][i] + s["demand_fix_V"][i], s["temperature_C"])
            s["demand_fix_V"][i] = 0.0
        s["step"] += 1
        if k + 1 == STEPS_PER_MS:
            copy(nodes[ms + 1], s["pose"])
            room(p, s, slow[ms])
        else:
            pose_between(s["quintic"], (k + 1.0) / STEPS_PER_MS, NODE_S, s["pose"])
        copy(noise[j], s["noise"])
        sense(p, s, s["noise"])
        if k + 1 == STEPS_PER_MS:
            truth_row(p, s, parts[ms], truth[row])
            row += 1
    if stop > first:
        outputs(p, s, 0.0)
    return row
