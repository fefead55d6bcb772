"""The lab's scan of the manipulator: the tip under an optical tracker, the stacks under interferometers.

Every stack goes through a grid of voltages; at each point the tip is averaged in the body's frame and the stroke of
each stack is averaged too, so that hysteresis and geometry come apart.
"""

from __future__ import annotations

import itertools

import numpy as np

from hal.arrays import Array
from sim_devices.config import EmulationConfig
from sim_devices.plant.kernel import STEP_S
from sim_devices.plant.manipulator import take_up, tip_displacement
from sim_devices.plant.stack import drive_channel, drive_step
from sim_devices.plant.unit import build_unit, start_temperature_C

TRACKER_RMS_UM = 0.7
"""Noise of one sample and axis of the optical reference that the authors of source Latt 2011 used."""
INTERFEROMETER_RMS_UM = 0.07
SAMPLES = 200
SETTLE_S = 0.05


def scan_grid(per_axis: int) -> Array:
    """Return volts (n, 3): a grid through all corners of 5 to 95 V, back and forth so that steps are small."""
    levels = np.linspace(5.0, 95.0, per_axis)
    points: list[tuple[float, float, float]] = []
    for i, (a, b) in enumerate(itertools.product(levels, levels)):
        row = levels if i % 2 == 0 else levels[::-1]
        points += [(float(a), float(b), float(c)) for c in row]
    return np.array(points)


def measure_scan(config: EmulationConfig, per_axis: int, rng: np.random.Generator) -> tuple[dict[str, Array], str]:
    """Return the columns (n,) of the scan and its descriptor. Strokes and tip (m) count from rest at neutral."""
    unit = build_unit(config, config.unit)
    temperature_C = start_temperature_C(config)
    channels = [drive_channel(stack, config.amplifier, STEP_S, temperature_C) for stack in unit.stacks]
    m = unit.manipulator
    grid = scan_grid(per_axis)
    stroke, tip = np.empty((len(grid), 3)), np.empty((len(grid), 3))
    z, rest, at, seat = np.empty(3), np.empty(3), np.empty(3), np.zeros(3)
    tip_displacement(m.rest_m, m.circle_m, m.shaft_m, rest)
    for k, volts in enumerate(grid):
        for i, (params, state) in enumerate(channels):
            for _ in range(round(SETTLE_S / STEP_S)):
                drive_step(params[0], state[0], volts[i], temperature_C)
            stroke[k, i] = state[0]["mode"][0] - params[0]["reference_m"]
            z[i] = m.rest_m[i] + m.lever[i] * stroke[k, i]
        tip_displacement(z, m.circle_m, m.shaft_m, at)
        tip[k] = m.mount @ (at - rest)
        take_up(m.play_m, seat, tip[k])
    noise = rng.standard_normal((2, len(grid), 3)) / np.sqrt(SAMPLES)
    columns = {
        "command_V": grid,
        "stroke_um": stroke * 1e6 + INTERFEROMETER_RMS_UM * noise[0],
        "tip_um": tip * 1e6 + TRACKER_RMS_UM * noise[1],
    }
    descriptor = f"""format = 1
title = "manipulator of unit {config.unit}: {len(grid)} positions, mean of {SAMPLES} samples each"
data = "data.npz"
# command_V (n, 3); stroke_um (n, 3) of each stack and tip_um (n, 3) in the body frame, from rest at neutral
"""
    return columns, descriptor
