"""Computes offsets by the methods of Erat 2018: manual and simple (5.2.1), and the gyroscope's mean (5.3.1).

Free fall is in ``tools.calibrate.quick``.

An offset is what the sensor shows too much; its offset register takes the negative (erratum 115).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from tools.calibrate.still import quiet_level, spread
from tools.errors import InputError
from tools.imu.series import AXES, Array, Series

UPRIGHT = 0.97
"""A pole counts as reached when the axis came within this much of 1 g of the widest reading of all axes."""
STILL_FACTOR = 4.0


@dataclass(frozen=True)
class ManualOffset:
    """``offset_g`` (3,) = (max + min) / 2 and ``scale`` (3,) = (max - min) / 2 (erratum 116).

    ``poles``: the axis directions (such as "-y") that no still moment came close to: their extremes say nothing.
    """

    offset_g: Array
    scale: Array
    poles: tuple[str, ...]


def manual(series: Series) -> ManualOffset:
    """Compute offsets (3,) in g from a slow recording in which every axis pointed straight up once and straight down
    once.

    Moments of fast motion are left out (they read more than gravity), the rest is averaged over 0.2 s.
    """
    accel = series.accel_g
    window = max(3, round(0.2 * series.rate_hz))
    if len(accel) < 10 * window:
        raise InputError(f"{series.name}: {series.seconds:.1f} s are too short to turn a sensor through six directions")
    calm = spread(accel, window) < max(STILL_FACTOR * quiet_level(accel, window), 0.02)
    smooth = np.stack([np.convolve(accel[:, i], np.full(window, 1.0 / window), "same") for i in range(3)], axis=1)
    smooth = smooth[window:-window][calm[window:-window]]
    if len(smooth) < window:
        raise InputError(
            f"{series.name}: the sensor never turned slowly enough to measure gravity alone; take 5 s a turn"
        )
    top, bottom = smooth.max(axis=0), smooth.min(axis=0)
    reach = float(np.max(top - bottom)) / 2.0
    missing = [f"+{a}" for a, v in zip(AXES, top, strict=True) if v < UPRIGHT * reach - 0.1]
    missing += [f"-{a}" for a, v in zip(AXES, bottom, strict=True) if -v < UPRIGHT * reach - 0.1]
    return ManualOffset((top + bottom) / 2.0, (top - bottom) / 2.0, tuple(missing))


def simple(series: Series) -> Array:
    """Return offsets (3,) in g: the mean of a sensor that lies on a flat surface, minus 1 g on the axis that is
    vertical (erratum 115)."""
    mean = series.accel_g.mean(axis=0)
    vertical = int(np.argmax(np.abs(mean)))
    mean[vertical] -= np.sign(mean[vertical])
    return mean


def gyroscope_mean(series: Series) -> Array:
    """Return the mean (3,) in deg/s while motionless (5.3.1). Raises ``InputError`` without a gyroscope."""
    if series.gyro_dps is None:
        raise InputError(f"{series.name}: no gyroscope; name its columns gyro_x_deg_s or gyro_x_rad_s, and y, z")
    return series.gyro_dps.mean(axis=0)


def moved(series: Series) -> str | None:
    """Why the sensor cannot have lain still, or None: means of half seconds jump by more than 50 mg or 3 deg/s."""
    blocks = max(2, int(series.seconds / 0.5))
    for data, limit, unit in ((series.accel_g, 0.05, "g"), (series.gyro_dps, 3.0, "deg/s")):
        if data is None:
            continue
        means = np.array([part.mean(axis=0) for part in np.array_split(data, blocks)])
        # the slow part may be temperature: what counts is the step from one block to the next
        jump = float(np.max(np.abs(np.diff(means, axis=0))))
        if jump > limit:
            return f"its readings jump by {jump:.3g} {unit} within half a second"
    return None
