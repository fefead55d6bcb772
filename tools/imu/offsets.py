"""Computes offsets by the four methods of Erat 2018: manual, free fall and simple (5.2.1), and the gyroscope's mean
(5.3.1).

An offset is what the sensor shows too much; its offset register takes the negative (erratum 115).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from hal.types import STANDARD_GRAVITY
from tools.calibrate.still import quiet_level, spread
from tools.errors import InputError
from tools.imu.series import AXES, Array, Series

UPRIGHT = 0.97
"""A pole counts as reached when the axis came within this much of 1 g of the widest reading of all axes."""
FALL_G = 0.5
SHORTEST_FALL_S = 0.05
BOUNCE_S = 0.005
NEAR_G = 0.1
EDGE_SHARE = 0.1
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
        raise InputError(f"{series.name}: the sensor was never led slowly enough to feel gravity alone")
    top, bottom = smooth.max(axis=0), smooth.min(axis=0)
    reach = float(np.max(top - bottom)) / 2.0
    missing = [f"+{a}" for a, v in zip(AXES, top, strict=True) if v < UPRIGHT * reach - 0.1]
    missing += [f"-{a}" for a, v in zip(AXES, bottom, strict=True) if -v < UPRIGHT * reach - 0.1]
    return ManualOffset((top + bottom) / 2.0, (top - bottom) / 2.0, tuple(missing))


@dataclass(frozen=True)
class FreeFall:
    """Holds ``offset_g`` (3,), the mean while falling, and ``start_s`` and ``seconds`` of the fall."""

    offset_g: Array
    start_s: float
    seconds: float

    @property
    def speed_m_s(self) -> float:
        """Return the speed at the end of the fall, from rest."""
        return STANDARD_GRAVITY * self.seconds


def free_fall(series: Series) -> FreeFall | None:
    """The longest time that the reading stood still near zero; None when there is none of 50 ms.

    Searched where |a| is below half of 1 g; falling is what stays within 0.1 g of the quietest 50 ms there (resistance
    of a liquid, a rope or the air that grows afterwards ends it). A rebound of less than 5 ms (what held the sensor
    lets go with a jerk) does not. The offset leaves out a tenth at either end.
    """
    accel = series.accel_g
    low = _runs(np.linalg.norm(accel, axis=1) < FALL_G, 0)
    shortest = max(3, round(SHORTEST_FALL_S * series.rate_hz))
    best: tuple[int, int] | None = None
    for start, stop in low:
        if stop - start < shortest:
            continue
        quiet = start + int(np.argmin(spread(accel[start:stop], shortest)))
        around = accel[max(start, quiet - shortest // 2) : quiet + shortest // 2 + 1]
        off = np.linalg.norm(accel - np.median(around, axis=0), axis=1)
        for first, last in _runs(off < NEAR_G, max(1, round(BOUNCE_S * series.rate_hz))):
            if (
                first <= quiet < last
                and last - first >= shortest
                and (best is None or last - first > best[1] - best[0])
            ):
                best = first, last
    if best is None or best[0] == 0 or best[1] == len(accel):
        return None
    first, last = best
    margin = round(EDGE_SHARE * (last - first))
    mean = accel[first + margin : last - margin].mean(axis=0)
    return FreeFall(mean, first / series.rate_hz, (last - first) / series.rate_hz)


def _runs(here: NDArray[np.bool_], bridge: int) -> list[tuple[int, int]]:
    """(start, stop) of the runs of True; gaps of fewer than ``bridge`` samples are closed."""
    edges = np.flatnonzero(np.diff(np.concatenate([[False], here, [False]]).astype(np.int8))).reshape(-1, 2)
    runs: list[tuple[int, int]] = []
    for start, stop in edges.tolist():
        if runs and start - runs[-1][1] < bridge:
            runs[-1] = (runs[-1][0], stop)
        else:
            runs.append((start, stop))
    return runs


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
        raise InputError(f"{series.name}: no gyroscope columns gyro_x_UNIT ...")
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
