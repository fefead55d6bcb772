"""A small DC motor with a gear, integrated here in plain Python: recordings with and without physics that a twin lacks.

    python make.py FOLDER        # writes FOLDER/VARIANT/data.csv and one descriptor per kind of twin

Nothing is imported from this project: the numbers are those of somebody else's program.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

STEPS_HZ = 6000.0  # of the integration
VARIANTS = {
    "nothing": (),
    "backlash": ("gap",),
    "friction": ("friction",),
    "friction_and_backlash": ("friction", "gap"),
    "delay": ("delay",),
    "gravity": ("gravity",),
    "saturation": ("limit",),
    "stribeck": ("friction", "breakaway"),
}
"""Each recording has these of the motor's quantities; the others are absent."""


@dataclass(frozen=True)
class Motor:
    """One motor and its recording; the values here are those of the first."""

    seed: int = 1
    rate_hz: float = 100.0
    seconds: float = 20.0
    speed_per_V: float = 20.0  # rad/(s V)
    time_constant_s: float = 0.08
    noise_rad: float = 0.004  # of the angle's sensor
    friction: float = 0.35  # Coulomb friction, as the voltage that overcomes it
    breakaway: float = 0.3  # what has to be overcome from rest beyond that, V; gone by some multiples of
    stribeck_speed: float = 3.0  # rad/s
    gap: float = 0.3  # free play of the gear, rad
    delay: float = 0.04  # of the command, s
    gravity: float = 0.6  # of an eccentric load, V where it is largest
    limit: float = 1.3  # of the amplifier, V
    told_speed_per_V: float = 20.0
    told_time_constant_s: float = 0.08
    """The data sheet gives these two, and the engineer's own twin has them."""

    @property
    def n(self) -> int:
        return round(self.seconds * self.rate_hz)


def drawn(seed: int) -> Motor:
    """Another motor: every value is drawn, and the data sheet is right to some per cent."""
    rng = np.random.default_rng(seed)

    def between(lo: float, hi: float) -> float:
        return float(f"{math.exp(rng.uniform(math.log(lo), math.log(hi))):.3g}")

    gain, tau = between(10.0, 30.0), between(0.05, 0.15)
    return Motor(
        seed=seed,
        speed_per_V=gain,
        time_constant_s=tau,
        noise_rad=between(0.002, 0.006),
        friction=between(0.2, 0.5),
        breakaway=between(0.15, 0.4),
        stribeck_speed=between(1.0, 5.0),
        gap=between(0.1, 0.5),
        delay=between(0.015, 0.06),
        gravity=between(0.3, 0.8),
        limit=between(1.0, 1.5),
        told_speed_per_V=float(f"{gain * rng.uniform(0.97, 1.03):.3g}"),
        told_time_constant_s=float(f"{tau * rng.uniform(0.95, 1.05):.3g}"),
    )


def command(motor: Motor) -> Array:
    """Volts (n,): levels held for a random time, smoothed over 90 ms, beside a slow sine."""
    rng = np.random.default_rng(motor.seed)
    per = round(motor.rate_hz / 100.0)
    n = motor.n // per
    levels = np.repeat(rng.uniform(-2.0, 2.0, n), rng.integers(10, 80, n))[:n]
    kernel = np.hanning(9 * per) / np.hanning(9 * per).sum()
    t = np.arange(motor.n) / motor.rate_hz
    return np.convolve(np.repeat(levels, per), kernel, "same") + 0.4 * np.sin(2 * np.pi * 0.23 * t)


def turn(motor: Motor, volts: Array, what: tuple[str, ...] = ()) -> Array:
    """The angle of the load (n,), rad: semi-implicit Euler steps, friction as a bounded reaction, play as a gap.

    ``what`` of the motor's quantities is there.
    """
    has = {name: getattr(motor, name) if name in what else 0.0 for name in ("friction", "breakaway", "gravity", "gap")}
    n, steps = motor.n, max(4, round(STEPS_HZ / motor.rate_hz))
    h = 1.0 / (motor.rate_hz * steps)
    fine = np.arange((n - 1) * steps) * h - (motor.delay if "delay" in what else 0.0)
    u = np.interp(fine, np.arange(n) / motor.rate_hz, volts)
    if "limit" in what:
        u = np.clip(u, -motor.limit, motor.limit)
    per_V = h * motor.speed_per_V / motor.time_constant_s
    speed = shaft = load = 0.0
    angle = np.zeros(n)
    for i, v in enumerate(u.tolist()):
        speed += per_V * (v - has["gravity"] * math.sin(shaft)) - h * speed / motor.time_constant_s
        brake = per_V * (has["friction"] + has["breakaway"] * math.exp(-abs(speed) / motor.stribeck_speed))
        speed -= math.copysign(min(abs(speed), brake), speed)
        shaft += h * speed
        load = min(max(load, shaft - has["gap"] / 2), shaft + has["gap"] / 2)
        if (i + 1) % steps == 0:
            angle[(i + 1) // steps] = load
    return angle


def record(motor: Motor, variant: str) -> dict[str, Array]:
    """The columns of one recording: time, command, measured angle, and the angle of the engineer's simulation."""
    volts = command(motor)
    noise = motor.noise_rad * np.random.default_rng(motor.seed + 1000).standard_normal(volts.size)
    told = Motor(
        rate_hz=motor.rate_hz,
        seconds=motor.seconds,
        speed_per_V=motor.told_speed_per_V,
        time_constant_s=motor.told_time_constant_s,
    )
    return {
        "time_s": np.arange(volts.size) / motor.rate_hz,
        "command_V": volts,
        "angle_rad": turn(motor, volts, VARIANTS[variant]) + noise,
        "angle_simulated_rad": turn(told, volts),
    }
