"""The lab's record of the moving tip: slow loops of all three stacks, under interferometers and an optical tracker.

Each stack swings at a frequency of its own and the swings shrink, so the tip turns back at many places after travels
of every size: what the geometry alone cannot explain, such as a play in the mount, shows.
"""

from __future__ import annotations

import math

import numpy as np

from hal.arrays import Array
from sim_devices.config import EmulationConfig
from sim_devices.plant.kernel import STEP_S
from sim_devices.plant.lab import drive_stack
from sim_devices.plant.lab_scan import INTERFEROMETER_RMS_UM, TRACKER_RMS_UM
from sim_devices.plant.manipulator import take_up, tip_displacement
from sim_devices.plant.stack import drive_channel
from sim_devices.plant.streams import stream
from sim_devices.plant.unit import build_unit, start_temperature_C

SWINGS_HZ = (0.23, 0.31, 0.41)
AMPLITUDE_V = 40.0
READ_HZ = 1000.0
MEAN_OF = 20
"""Samples of tracker and interferometers whose mean is one row."""
TIP_HZ = READ_HZ / MEAN_OF


def measure_tip(config: EmulationConfig, seconds: float) -> dict[str, Array]:
    """Return ``stroke_um`` and ``tip_um``, both (n, 3), at ``TIP_HZ``; they count from rest at neutral."""
    unit, n = build_unit(config, config.unit), round(seconds * TIP_HZ)
    t = np.arange(n * MEAN_OF) / READ_HZ
    shrink = 0.05 ** ((2.0 * t / seconds) % 1.0)
    stroke = np.empty((t.size, 3))
    for i, hz in enumerate(SWINGS_HZ):
        volts = config.amplifier.neutral_V + AMPLITUDE_V * shrink * np.sin(2.0 * math.pi * hz * t)
        temperature_C = start_temperature_C(config)
        params, state = drive_channel(unit.stacks[i], config.amplifier, STEP_S, temperature_C)
        rest_m, moved = state[0]["mode"][0], np.empty(t.size)
        drive_stack(params, state, volts, temperature_C, round(1.0 / (READ_HZ * STEP_S)), (moved, np.empty(t.size)))
        stroke[:, i] = moved - rest_m
    m = unit.manipulator
    tip, at, rest, seat = np.empty((t.size, 3)), np.empty(3), np.empty(3), np.zeros(3)
    tip_displacement(m.rest_m, m.circle_m, m.shaft_m, rest)
    for k in range(t.size):
        tip_displacement(m.rest_m + m.lever * stroke[k], m.circle_m, m.shaft_m, at)
        tip[k] = m.mount @ (at - rest)
        take_up(m.play_m, seat, tip[k])
    noise = stream(config.seed, "lab.tip").standard_normal((2, n, 3)) / math.sqrt(MEAN_OF)
    rows = [1e6 * x.reshape(n, MEAN_OF, 3).mean(axis=1) for x in (stroke, tip)]
    return {
        "stroke_um": rows[0] + INTERFEROMETER_RMS_UM * noise[0],
        "tip_um": rows[1] + TRACKER_RMS_UM * noise[1],
    }
