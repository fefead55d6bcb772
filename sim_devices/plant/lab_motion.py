"""Makes recordings of the whole instrument at 1 kHz: at rest on a table, or swung about its tip in a dimple.

``rest`` is what a noise model is made from. ``pivot`` shows where the sensors sit: the tip stays, so every acceleration
is the turn's; swings of up to 35 degrees about all axes with several frequencies below 2.5 Hz, as an arm makes them.
"""

from __future__ import annotations

import numpy as np

from hal.arrays import Array
from hal.compiled import kernel
from hal.errors import BenchError
from sim_devices.config import EmulationConfig
from sim_devices.plant.hand import NODE_S, holding_frame
from sim_devices.plant.kernel import NOISES, SLOW_NOISES, STEPS_PER_MS, TRUTH_COLUMNS, begin, copy, outputs, room, sense
from sim_devices.plant.sensors import sensor_unit
from sim_devices.plant.streams import stream
from sim_devices.plant.unit import build_unit, plant_arrays

LSB_V = 10.0 / 65536.0
ADC_V = 187.5e-6  # ADS1115 at +-6.144 V
ADC_EVERY = 10
BLOCK = 10_000
START_S = 2.0
SWINGS = (  # angle, amplitude in degrees, frequency in Hz
    *((0, a, f) for a, f in ((16.0, 0.23), (6.0, 0.71), (4.0, 1.37), (2.0, 2.29))),
    *((1, a, f) for a, f in ((15.0, 0.31), (6.0, 0.83), (4.0, 1.49), (2.0, 2.03))),
    *((2, a, f) for a, f in ((30.0, 0.19), (14.0, 0.61), (8.0, 1.61), (4.0, 2.41))),
)


def pivot_path(seconds: float, seed: int) -> Array:
    """(n, 18) nodes of a hand: the tip stands still, the three angles swing; derivatives are exact."""
    t = np.arange(1, round(seconds / NODE_S) + 1) * NODE_S
    # starts and ends at rest: a smooth window with its derivatives
    x = np.clip(np.minimum(t, seconds - t) / START_S, 0.0, 1.0)
    way = np.where(t < 0.5 * seconds, 1.0, -1.0) / START_S
    window = np.array(
        [
            x**3 * (10.0 - 15.0 * x + 6.0 * x**2),
            way * 30.0 * x**2 * (1.0 - x) ** 2,
            way**2 * 60.0 * x * (1.0 - x) * (1.0 - 2.0 * x),
        ]
    )
    nodes = np.zeros((len(t), 18))
    phases = stream(seed, "lab.pivot").uniform(0.0, 2.0 * np.pi, len(SWINGS))
    for (angle, degrees, hz), phase in zip(SWINGS, phases, strict=True):
        w = 2.0 * np.pi * hz
        swing = np.radians(degrees) * np.array(
            [np.sin(w * t + phase), w * np.cos(w * t + phase), -w * w * np.sin(w * t + phase)]
        )
        nodes[:, 3 + angle] += window[0] * swing[0]
        nodes[:, 9 + angle] += window[0] * swing[1] + window[1] * swing[0]
        nodes[:, 15 + angle] += window[0] * swing[2] + 2.0 * window[1] * swing[1] + window[2] * swing[0]
    return nodes


SHAKES_HZ = (3.0, 4.0, 6.0, 8.0, 10.0, 12.0, 16.0, 20.0, 25.0, 30.0, 38.0, 46.0)
"""Frequencies of the shaker, along x, y and z in turn."""
SHAKE_M_S2 = 0.5
"""Amplitude of the acceleration at each of them."""


def shake_path(seconds: float) -> Array:
    """(n, 18) nodes of a shaker: sinusoids along the world's axes, each with the same acceleration."""
    t = np.arange(1, round(seconds / NODE_S) + 1) * NODE_S
    nodes = np.zeros((len(t), 18))
    for k, hz in enumerate(SHAKES_HZ):
        w, axis = 2.0 * np.pi * hz, k % 3
        nodes[:, axis] -= SHAKE_M_S2 / w**2 * np.sin(w * t)
        nodes[:, 6 + axis] -= SHAKE_M_S2 / w * np.cos(w * t)
        nodes[:, 12 + axis] += SHAKE_M_S2 * np.sin(w * t)
    return nodes


@kernel
def sense_at(p, s, node, noise, slow):
    """Compute a millisecond of the sensors from hand node (18,), noise (NOISES,), slow (SLOW_NOISES,)."""
    copy(node, s["pose"])
    s["step"] += STEPS_PER_MS
    room(p, s, slow)
    copy(noise, s["noise"])
    sense(p, s, s["noise"])


@kernel
def record(plant, state, block, first, held, out):
    """``out``: analog (n, 8) and magnetic (n, 3) V as the converters give them. ``block``: hand nodes (n, 18), noise
    and slow noise."""
    p, s = plant[0], state[0]
    nodes, noise, slow = block
    analog, magnet = out
    for k in range(nodes.shape[0]):
        sense_at(p, s, nodes[k], noise[k], slow[k])
        outputs(p, s, 0.0)
        for i in range(8):
            analog[k, i] = LSB_V * min(max(np.round(s["daq_V"][i] / LSB_V), -32768.0), 32767.0)
        if (first + k) % ADC_EVERY == 0:
            for i in range(3):
                held[i] = ADC_V * np.round(s["magnetometer_V"][i] / ADC_V)
        copy(held, magnet[k])


def measure_motion(config: EmulationConfig, kind: str, seconds: float) -> tuple[dict[str, Array], str]:
    """Return columns (n,) at 1 kHz and their descriptor. ``kind`` is ``rest``, ``pivot`` or ``shake``; the last has the
    acceleration of the shaker as well.
    """
    shortest = 10.0 if kind == "pivot" else 1.0
    if not shortest <= seconds <= 3600.0:
        raise BenchError(f"{seconds:g} s: give {shortest:g} to 3600 s")
    n = round(seconds / NODE_S)
    nodes = np.zeros((n, 18))
    if kind == "pivot":
        nodes = pivot_path(seconds, config.seed)
    elif kind == "shake":
        nodes = shake_path(seconds)
    plant, state = plant_arrays(config, build_unit(config, config.unit), holding_frame(config.hand))
    # one step per millisecond: the RC filters are exact for input that is linear in between
    plant[0]["accelerometer"] = sensor_unit(config.sensors, config.instrument, config.unit, NODE_S).accelerometers
    plant[0]["sense_s"] = NODE_S
    begin(plant, state, nodes[0] if kind == "shake" else np.zeros(18), np.zeros(6), np.zeros(TRUTH_COLUMNS))
    rng = stream(config.seed, f"lab.{kind}")
    analog, magnet, held = np.empty((n, 8)), np.empty((n, 3)), np.zeros(3)
    for first in range(0, n, BLOCK):
        part = slice(first, min(n, first + BLOCK))
        count = part.stop - first
        noise, slow = rng.standard_normal((count, NOISES)), rng.standard_normal((count, SLOW_NOISES))
        record(plant, state, (nodes[part], noise, slow), first, held, (analog[part], magnet[part]))
    columns = {"analog_V": analog, "magnetometer_V": magnet}
    if kind == "shake":
        columns["acceleration_m_s2"] = nodes[:, 12:15]
    what = {"pivot": "swung about its tip, which stands in a dimple", "shake": "on a shaker"}.get(
        kind, "at rest on a table"
    )
    descriptor = f"""format = 1
title = "unit {config.unit} {what}"
data = "data.npz"
rate_hz = {1.0 / NODE_S}
# analog_V (n, 8): a1x, a1z, a2y, a2z, a3x, a3y, supply / 2, TMP36; magnetometer_V (n, 3), a value every 10 ms
"""
    return columns, descriptor
