"""A small DC motor with a gear, integrated here in plain numpy: recordings with and without physics that a twin lacks.

    python make.py FOLDER        # writes FOLDER/VARIANT/data.csv and one descriptor per kind of twin

Nothing is imported from this project: the numbers are those of somebody else's program.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

RATE_HZ = 100.0
SECONDS = 20.0
SPEED_PER_V = 20.0  # rad/(s V)
TIME_CONSTANT_S = 0.08
FRICTION_V = 0.35  # Coulomb friction, as the voltage that it takes to overcome it
GAP_RAD = 0.3  # free play of the gear
DELAY_S = 0.04  # of the command
NOISE_RAD = 0.004  # of the angle's sensor
STEPS = 60  # of the integration, per sample

VARIANTS = {
    "nothing": {},
    "backlash": {"gap": GAP_RAD},
    "friction": {"friction": FRICTION_V},
    "friction_and_backlash": {"friction": FRICTION_V, "gap": GAP_RAD},
    "delay": {"delay": DELAY_S},
}


def command(seed: int = 1) -> Array:
    """Volts (n,): levels held for a random time, smoothed, beside a slow sine."""
    rng = np.random.default_rng(seed)
    n = round(SECONDS * RATE_HZ)
    levels = np.repeat(rng.uniform(-2.0, 2.0, n), rng.integers(10, 80, n))[:n]
    kernel = np.hanning(9) / np.hanning(9).sum()
    t = np.arange(n) / RATE_HZ
    return np.convolve(levels, kernel, "same") + 0.4 * np.sin(2 * np.pi * 0.23 * t)


def turn(volts: Array, *, friction: float = 0.0, gap: float = 0.0, delay: float = 0.0) -> Array:
    """The angle of the load (n,), rad: semi-implicit Euler steps, friction as a bounded reaction, play as a gap."""
    n, h = volts.size, 1.0 / (RATE_HZ * STEPS)
    t = np.arange(n) / RATE_HZ
    speed = motor = load = 0.0
    angle = np.empty(n)
    for k in range(n):
        angle[k] = load
        for i in range(STEPS):
            u = float(np.interp(t[k] + i * h - delay, t, volts)) if delay else _between(volts, k, i)
            speed += h * (SPEED_PER_V * u - speed) / TIME_CONSTANT_S
            brake = h * SPEED_PER_V * friction / TIME_CONSTANT_S
            speed -= np.sign(speed) * min(abs(speed), brake)
            motor += h * speed
            load = min(max(load, motor - gap / 2), motor + gap / 2)
    return angle


def _between(volts: Array, k: int, i: int) -> float:
    last = min(k + 1, volts.size - 1)
    return float(volts[k] + (volts[last] - volts[k]) * i / STEPS)


def record(variant: str, seed: int = 1) -> dict[str, Array]:
    """The columns of one recording: time, command, measured angle, and the angle of the engineer's simulation."""
    volts = command(seed)
    noise = NOISE_RAD * np.random.default_rng(seed + 1000).standard_normal(volts.size)
    return {
        "time_s": np.arange(volts.size) / RATE_HZ,
        "command_V": volts,
        "angle_rad": turn(volts, **VARIANTS[variant]) + noise,
        "angle_simulated_rad": turn(volts),
    }
