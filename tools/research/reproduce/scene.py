"""The emulated sensors in a hand and the firmware's sensing stage, both compiled, one millisecond a step.

Half an hour runs in seconds: no converter protocol, no stacks (their magnetic field is absent), the RC filters
stepped once a millisecond (exact for inputs that run straight between samples). Everything else is the emulated
instrument's own code: sensors, room, supply, hand.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from firmware_py.frame import COUNTS, LAYOUT, MAGNETOMETER_FRESH, MAGNETOMETER_RAW, STATUS, TICK
from firmware_py.sensing.config import SensingConfig
from firmware_py.sensing.stage import Sensing, sense_kernel
from hal.arrays import Array
from hal.compiled import kernel
from sim_devices.config import EmulationConfig
from sim_devices.plant.hand import NODE_S, Hand
from sim_devices.plant.kernel import NOISES, SLOW_NOISES, TRUTH_COLUMNS, begin, outputs
from sim_devices.plant.lab_motion import sense_at
from sim_devices.plant.rigid_body import quaternion
from sim_devices.plant.sensors import sensor_unit
from sim_devices.plant.streams import stream
from sim_devices.plant.unit import build_unit, plant_arrays

LSB_V = 10.0 / 65536.0
ADC_V = 187.5e-6  # ADS1115 at +-6.144 V
ADC_EVERY = 10  # ticks
BLOCK = 1000
COLUMNS = (
    ("quaternion", 4),
    ("true_quaternion", 4),
    ("true_tip_m", 3),  # world
    ("tip_displacement_m", 3),  # as the frame has it, body
    ("tip_acceleration_m_s2", 3),
    ("rate_rad_s", 3),
    ("true_rate_rad_s", 3),
    ("specific_force_m_s2", 3),
    ("field_uT", 3),
    ("accelerometer_m_s2", 6),
    ("status", 1),
)
OUT = sum(width for _, width in COLUMNS)
_FORCE = LAYOUT.start("specific_force")
_FIELD = LAYOUT.start("magnetometer")
_AXES = LAYOUT.start("accelerometer")
_QUATERNION = LAYOUT.start("quaternion")
_TIP = LAYOUT.start("tip_displacement")
_TIP_A = LAYOUT.start("tip_acceleration")
_RATE = LAYOUT.start("rate")


@kernel
def scene_kernel(plant, state, nodes, noise, slow, first, sense_state, sense_params, frame, out):
    """``out`` (n, OUT) from hand nodes (n, 18), noise (n, NOISES), slow (n, SLOW_NOISES)."""
    p, s = plant[0], state[0]
    for k in range(nodes.shape[0]):
        sense_at(p, s, nodes[k], noise[k], slow[k])
        outputs(p, s, 0.0)
        frame[TICK] = first + k
        frame[STATUS] = 0.0
        for i in range(8):
            frame[COUNTS + i] = min(max(np.round(s["daq_V"][i] / LSB_V), -32768.0), 32767.0)
        frame[MAGNETOMETER_FRESH] = 0.0
        if (first + k) % ADC_EVERY == 0:
            frame[MAGNETOMETER_FRESH] = 1.0
            for i in range(3):
                frame[MAGNETOMETER_RAW + i] = ADC_V * np.round(s["magnetometer_V"][i] / ADC_V)
        sense_kernel(frame, sense_state, sense_params)
        row = out[k]
        quaternion(s["attitude"], row[4:8])
        for i in range(4):
            row[i] = frame[_QUATERNION + i]
        for i in range(3):
            row[8 + i] = nodes[k, i]
            row[11 + i] = frame[_TIP + i]
            row[14 + i] = frame[_TIP_A + i]
            row[17 + i] = frame[_RATE + i]
            row[20 + i] = s["rate"][i]
            row[23 + i] = frame[_FORCE + i]
            row[26 + i] = frame[_FIELD + i]
        for i in range(6):
            row[29 + i] = frame[_AXES + i]
        row[35] = frame[STATUS]


@dataclass(frozen=True)
class SceneResult:
    """Arrays (n, width) by the names of ``COLUMNS``, every ``step`` ms."""

    columns: dict[str, Array]
    step_s: float

    def __getitem__(self, name: str) -> Array:
        return self.columns[name]


def run_scene(
    config: EmulationConfig, sensing: SensingConfig, hand: Hand, seconds: float, *, every: int = 1
) -> SceneResult:
    """Run unit ``config.unit`` with noise ``config.seed`` and keep every ``every``-th millisecond."""
    unit = build_unit(config, config.unit)
    plant, state = plant_arrays(config, unit, hand.frame)
    plant[0]["accelerometer"] = sensor_unit(config.sensors, config.instrument, config.unit, NODE_S).accelerometers
    rng = stream(config.seed, "scene.noise")
    nodes, part = np.zeros((BLOCK, 18)), np.zeros(6)
    hand.start(nodes[0], part)
    begin(plant, state, nodes[0], part, np.zeros(TRUTH_COLUMNS))
    firmware, frame = Sensing(sensing), LAYOUT.new_frame()
    total = round(seconds / NODE_S)
    kept = np.empty((-(-total // every), OUT))
    out, parts = np.empty((BLOCK, OUT)), np.zeros((BLOCK, 6))
    for first in range(0, total, BLOCK):
        n = min(BLOCK, total - first)
        hand.fill(nodes[:n], parts[:n])
        noise, slow = rng.standard_normal((n, NOISES)), rng.standard_normal((n, SLOW_NOISES))
        scene_kernel(plant, state, nodes[:n], noise, slow, first, firmware.state, firmware.params, frame, out[:n])
        skip = -first % every
        rows = out[skip:n:every]
        at = (first + skip) // every
        kept[at : at + len(rows)] = rows
    columns, at = {}, 0
    for name, width in COLUMNS:
        columns[name] = kept[:, at : at + width]
        at += width
    return SceneResult(columns, every * NODE_S)
