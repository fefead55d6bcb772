"""Measures a sensor of a bench: it records at its rate and auto-calibrates (Erat 2018, section 5.4)."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np

from drivers.base import wait_s
from drivers.imu.base import Imu, ImuBlock, ImuOffsets
from firmware_py.endoscope.wiring import Sensor
from hal.arrays import Array
from hal.contracts import Clock
from hal.types import STANDARD_GRAVITY, Status
from tools.errors import InputError
from tools.imu.offsets import gyroscope_mean, moved, simple
from tools.imu.series import Series

SETTLE_S, MEAN_S = 10.0, 10.0
PATIENCE_S = 2.0
Progress = Callable[[float], None]


def record(sensor: Sensor, clock: Clock, seconds: float, progress: Progress | None = None) -> Series:
    """Record ``seconds`` of samples; repeated ones are left out. Raises ``InputError`` when the sensor is silent for 2
    s."""
    n = max(1, round(seconds * sensor.rate_hz))
    if sensor.imu is not None and sensor.drain_hz:
        return _record_fifo(sensor, sensor.imu, clock, n, progress)
    accel, gyro, warm = np.empty((n, 3)), np.empty((n, 3)), np.empty(n)
    period_ns = round(1e9 / sensor.rate_hz)
    start_ns = last_ns = clock.now_ns()
    seen, got, lost = sensor.sample.seq, 0, sensor.lost
    while got < n:
        status = sensor.read()
        sample, now_ns = sensor.sample, clock.now_ns()
        if sample.seq != seen and not status & Status.STALE:
            accel[got], gyro[got], warm[got] = sample.accel_mps2, sample.gyro_rad_s, sample.temperature_C
            got, last_ns = got + 1, now_ns
            if progress is not None and got % 100 == 0:
                progress(got / n)
        elif now_ns - last_ns > PATIENCE_S * 1e9:
            raise InputError(_silent(sensor, got, n))
        if sample.seq == seen or sensor.card is None:
            # a chip is asked at its own rate, a card's queue is emptied first
            steps = max(1, math.ceil((clock.now_ns() - start_ns + 1) / period_ns))
            clock.sleep_until_ns(start_ns + steps * period_ns)
        seen = sample.seq
    return _series(sensor, accel, gyro, warm, lost)


def _record_fifo(sensor: Sensor, imu: Imu, clock: Clock, n: int, progress: Progress | None) -> Series:
    """Record ``n`` samples from the chip's FIFO, which is emptied ``drain_hz`` times a second."""
    block = ImuBlock()
    while imu.read_fifo(block) == block.capacity:  # samples from before the call
        pass
    accel, gyro, warm = np.empty((n, 3)), np.empty((n, 3)), np.empty(n)
    period_ns = round(1e9 / sensor.drain_hz)
    last_ns, due_ns, got, lost = clock.now_ns(), clock.now_ns(), 0, sensor.lost
    while got < n:
        due_ns = max(due_ns + period_ns, clock.now_ns())
        clock.sleep_until_ns(due_ns)
        k = min(imu.read_fifo(block), n - got)
        new = slice(got, got + k)
        accel[new], gyro[new], warm[new] = block.accel_mps2[:k], block.gyro_rad_s[:k], block.temperature_C
        got += k
        last_ns = clock.now_ns() if k else last_ns
        if clock.now_ns() - last_ns > PATIENCE_S * 1e9:
            raise InputError(_silent(sensor, got, n))
        if progress is not None:
            progress(got / n)
    return _series(sensor, accel, gyro, warm, lost)


def _silent(sensor: Sensor, got: int, n: int) -> str:
    return f"{sensor.name}: no sample for {PATIENCE_S:g} s after {got} of {n}; check link and power"


def _series(sensor: Sensor, accel: Array, gyro: Array, warm: Array, lost: int) -> Series:
    """Return the samples in g and deg/s; ``lost`` is the sensor's count of lost samples when the recording began."""
    temperature = warm if np.all(np.isfinite(warm)) else None
    return Series(
        sensor.name, sensor.rate_hz, accel / STANDARD_GRAVITY, np.degrees(gyro), temperature, sensor.lost - lost
    )


@dataclass(frozen=True)
class AutoCalibration:
    """Holds, per axis, the measured, written and remaining offsets, in g and deg/s.

    ``step_g``, ``step_dps``: what the registers' own steps leave. ``verified``: beyond that no more than the limits is.
    """

    found_g: tuple[float, ...]
    found_dps: tuple[float, ...]
    written_g: tuple[float, ...]
    written_dps: tuple[float, ...]
    left_g: tuple[float, ...]
    left_dps: tuple[float, ...]
    step_g: tuple[float, ...]
    step_dps: tuple[float, ...]
    limit_g: float = 0.002
    limit_dps: float = 0.1

    @property
    def verified(self) -> bool:
        worst = [
            max(abs(a - b) for a, b in zip(left, step, strict=True))
            for left, step in ((self.left_g, self.step_g), (self.left_dps, self.step_dps))
        ]
        return worst[0] <= self.limit_g and worst[1] <= self.limit_dps

    def as_dict(self) -> dict[str, Any]:
        return {**asdict(self), "verified": self.verified}


def auto_calibrate(
    sensor: Sensor,
    clock: Clock,
    *,
    settle_s: float = SETTLE_S,
    mean_s: float = MEAN_S,
    progress: Progress | None = None,
) -> AutoCalibration:
    """Settle, average, write minus the offset into the chip's registers, read back, measure again.

    The sensor lies motionless with one axis vertical. ``InputError`` when it moves, or has no registers to write (a
    card calibrates itself). The registers keep what is written until reset.
    """
    imu = sensor.imu
    if imu is None:
        raise InputError(f"{sensor.name}: offsets cannot be written through a motion card; it calibrates itself")
    before = imu.read_offsets()
    wait_s(clock, settle_s)
    first = record(sensor, clock, mean_s, progress)
    reason = moved(first)
    if reason is not None:
        raise InputError(f"{sensor.name}: it must lie still for auto-calibration, but {reason}")
    accel, gyro = simple(first), gyroscope_mean(first)
    old_accel, old_gyro = np.array(before.accel_mps2), np.array(before.gyro_rad_s)
    a, w = old_accel - accel * STANDARD_GRAVITY, old_gyro - np.radians(gyro)
    kept = imu.write_offsets(ImuOffsets((a[0], a[1], a[2]), (w[0], w[1], w[2])))
    wait_s(clock, 1.0)
    after = record(sensor, clock, mean_s, progress)
    left_accel, left_gyro = simple(after), gyroscope_mean(after)
    return AutoCalibration(
        tuple(accel.tolist()),
        tuple(gyro.tolist()),
        tuple((np.array(kept.accel_mps2) / STANDARD_GRAVITY).tolist()),
        tuple(np.degrees(kept.gyro_rad_s).tolist()),
        tuple(left_accel.tolist()),
        tuple(left_gyro.tolist()),
        tuple(((np.array(kept.accel_mps2) - a) / STANDARD_GRAVITY).tolist()),
        tuple(np.degrees(np.array(kept.gyro_rad_s) - w).tolist()),
    )
