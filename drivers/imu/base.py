"""Defines the interface of all inertial sensors of the bench.

Units are SI: m/s^2 (specific force, +g on an axis that points up), rad/s (right-hand rule), degC, T. Ranges are
chosen by the data sheets' names (2 g, 250 deg/s), because a chip has only these.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from enum import Enum
from typing import Literal, Protocol

import numpy as np

from hal.arrays import Array, Int32Array
from hal.errors import BenchError
from hal.scan_time import ScanTimeline
from hal.types import STANDARD_GRAVITY, ChannelInfo, Status, TimeSource

RAD_PER_DEG = math.pi / 180.0
AXES = ("x", "y", "z")
LATE = 0.02
"""Fraction of a period. A read that comes by less than this before the end of the second period has missed a sample."""

Mode = Literal["data ready", "fifo"]
Triple = tuple[float, float, float]


class PowerMode(Enum):
    """Names the power modes. ``LOW_POWER`` lowers the duty cycle or the noise performance; the driver names its
    rates."""

    NORMAL = "normal"
    LOW_POWER = "low power"
    ACCEL_ONLY = "accelerometer only"
    SLEEP = "sleep"


@dataclass(frozen=True, slots=True)
class ImuSetup:
    """Holds the settings that the chip really uses.

    Steps are per count; bandwidths are the -3 dB bandwidths of the data sheet."""

    rate_hz: float
    accel_range_g: float
    gyro_range_dps: float
    accel_lsb_mps2: float
    gyro_lsb_rad_s: float
    accel_bandwidth_hz: float
    gyro_bandwidth_hz: float


@dataclass(slots=True)
class ImuSample:
    """Holds one sample and is filled in place. ``raw`` (7,) holds counts: accelerometer, gyro, temperature.

    ``seq`` counts the chip's samples; ``lost`` samples are known to be missing before this one. A sample with
    ``Status.STALE`` repeats the last one: its ``t_ns`` and ``seq`` too. ``field_T`` is NaN without magnetometer.
    """

    accel_mps2: Array = field(default_factory=lambda: np.full(3, np.nan))
    gyro_rad_s: Array = field(default_factory=lambda: np.full(3, np.nan))
    field_T: Array = field(default_factory=lambda: np.full(3, np.nan))
    temperature_C: float = math.nan
    raw: Int32Array = field(default_factory=lambda: np.zeros(7, np.int32))
    t_ns: int = 0
    seq: int = -1
    lost: int = 0
    source: TimeSource = TimeSource.HOST
    status: Status = Status.STALE


class ImuBlock:
    """Holds the samples of one FIFO read: ``n`` rows, oldest first, taken ``dt_ns`` apart from ``t0_ns`` on."""

    def __init__(self, capacity: int = 512) -> None:
        self.accel_mps2: Array = np.full((capacity, 3), np.nan)
        self.gyro_rad_s: Array = np.full((capacity, 3), np.nan)
        self.raw: Int32Array = np.zeros((capacity, 6), np.int32)
        self.temperature_C = math.nan
        self.capacity = capacity
        self.n = 0
        self.t0_ns = 0
        self.dt_ns = 0
        self.seq0 = 0
        self.lost = 0
        self.source = TimeSource.DEVICE_CLOCK
        self.status = Status.OK


@dataclass(frozen=True, slots=True)
class ImuOffsets:
    """Holds the offsets that the chip adds to its readings (the negative of the error found), in m/s^2 and rad/s."""

    accel_mps2: Triple = (0.0, 0.0, 0.0)
    gyro_rad_s: Triple = (0.0, 0.0, 0.0)


@dataclass(frozen=True, slots=True)
class AxisTest:
    """Holds one axis of a self-test: the reaction ``value`` must lie in ``lo``..``hi`` (``unit``)."""

    axis: str
    value: float
    lo: float
    hi: float
    unit: str

    @property
    def passed(self) -> bool:
        return self.lo <= self.value <= self.hi


@dataclass(frozen=True, slots=True)
class SelfTestReport:
    """Holds all axes of a self-test with the data sheet's limits and the section that states them."""

    axes: tuple[AxisTest, ...]
    source: str

    @property
    def passed(self) -> bool:
        return all(axis.passed for axis in self.axes)


class Imu(Protocol):
    """Order of use: ``probe``, ``reset``, ``configure``, ``start``, then ``read`` or ``read_fifo``.

    Every wait goes through the bench clock and has a limit. ``lost`` and ``stale`` count since ``start``.
    """

    name: str
    setup: ImuSetup

    @property
    def lost(self) -> int: ...
    @property
    def stale(self) -> int: ...
    def probe(self) -> str:
        """Return the identity. Raises ``WrongDevice``, or ``I2cNack`` when no device answers."""
        ...

    def reset(self, limit_s: float = 0.1) -> None:
        """Set the chip to the data sheet's reset state. Raises ``HalTimeout`` after ``limit_s``."""
        ...

    def configure(
        self, *, rate_hz: float, accel_range_g: float, gyro_range_dps: float, bandwidth_hz: float | None = None
    ) -> ImuSetup:
        """Set rate, ranges and bandwidth, and return the settings that the chip uses.

        The rate is the chip's lowest that is not below ``rate_hz``, the bandwidth its highest that is not above
        ``bandwidth_hz`` (``None``: half the rate). Raises ``BenchError`` for a range that the chip does not have."""
        ...

    def start(self, mode: Mode = "data ready", limit_s: float = 0.5) -> None:
        """Begin to measure and wait for the first sample. Raises ``HalTimeout`` after ``limit_s``."""
        ...

    def read(self, out: ImuSample) -> Status:
        """Read the newest sample, all of one instant, into ``out``, and return its status: ``STALE`` if it is not new.
        Never waits. Needs mode "data ready"."""
        ...

    def read_fifo(self, out: ImuBlock) -> int:
        """Read the FIFO as far as ``out`` has room, and return ``out.n``. Needs mode "fifo"."""
        ...

    def read_offsets(self) -> ImuOffsets: ...

    def write_offsets(self, offsets: ImuOffsets) -> ImuOffsets:
        """Write the offsets, and return those that the chip keeps, in its own steps. Raises ``BenchError`` for an
        offset out of range."""
        ...

    def self_test(self, limit_s: float = 3.0) -> SelfTestReport:
        """Run the data sheet's self-test, with the instrument at rest. The chip is configured and started as before at
        the end."""
        ...

    def power(self, mode: PowerMode) -> None: ...
    def channels(self) -> Sequence[ChannelInfo]: ...


def pick_range(value: float, codes: dict[float, int], what: str, name: str) -> int:
    """Return the chip's code of a range. Raises ``BenchError``, which lists the ranges of the chip."""
    if value not in codes:
        raise BenchError(f"{what} = {value:g} is not one of {', '.join(f'{v:g}' for v in sorted(codes))}", device=name)
    return codes[value]


def pick_rate(rate_hz: float, codes: dict[float, int], name: str) -> tuple[float, int]:
    """Return the lowest rate of the chip that is not below ``rate_hz``, and its code."""
    good = [rate for rate in sorted(codes) if rate >= rate_hz * 0.999]
    if not good or rate_hz <= 0:
        raise BenchError(f"rate_hz = {rate_hz:g} is outside 0 .. {max(codes):g} Hz", device=name)
    return good[0], codes[good[0]]


def pick_bandwidth(bandwidth_hz: float, codes: dict[float, int]) -> tuple[float, int]:
    """Return the highest bandwidth of the chip that is not above ``bandwidth_hz`` (or its lowest), and its code."""
    good = [b for b in sorted(codes) if b <= bandwidth_hz] or [min(codes)]
    return good[-1], codes[good[-1]]


class SampleCounter:
    """Counts samples and losses of a chip that only reports "new" or "not new": a chip of period T that is read again
    after t has taken at least floor(t/T) samples, of which one was read."""

    def __init__(self) -> None:
        self.restart(1)

    def restart(self, period_ns: int) -> None:
        self.seq = -1
        self.lost = 0
        self.stale = 0
        self.t_ns = 0
        self._period_ns = period_ns

    def fresh(self, t_ns: int) -> int:
        """Count a new sample at ``t_ns`` (bench clock), and return the number that were certainly lost before it."""
        lost = 0
        if self.seq >= 0:
            lost = max(0, math.floor((t_ns - self.t_ns) / self._period_ns + LATE) - 1)
        self.seq += 1 + lost
        self.lost += lost
        self.t_ns = t_ns
        return lost

    def count(self, out: ImuSample, new: bool, t_ns: int) -> Status:
        """Fill time, number and loss of ``out`` for a reading at ``t_ns``, and return its status. A reading that is not
        ``new`` is ``STALE`` and keeps the last time and number."""
        if new:
            out.lost = self.fresh(t_ns)
            status = Status.OVERRUN if out.lost else Status.OK
        else:
            self.stale += 1
            out.lost = 0
            status = Status.STALE
        out.t_ns = self.t_ns
        out.seq = self.seq
        out.source = TimeSource.HOST
        return status


class FifoTimeline:
    """Stamps FIFO frames, which are ``period_ns`` apart by the chip's clock, with bench time, number and losses."""

    def __init__(self) -> None:
        self._forget(1)

    def restart(self, period_ns: int) -> None:
        """Begin a new count of frames that are ``period_ns`` apart, and load what the stamps need."""
        self._forget(period_ns)
        self._line.warm_up()

    def _forget(self, period_ns: int) -> None:
        self.next_seq = 0
        self.lost = 0
        self.period_ns = period_ns
        self._line = ScanTimeline(float(period_ns))
        self._last_ns = -1
        self._left = 0

    def stamp(self, out: ImuBlock, n: int, arrival_ns: int, overrun: bool, left: int = 0) -> None:
        """Fill times, numbers and losses of ``out`` for ``n`` frames read at ``arrival_ns`` (bench clock).

        ``overrun``: older frames were lost. ``left`` newer frames stayed in the FIFO for want of room. The chips do not
        report how many frames were lost; the time since the last read gives the number within one frame."""
        lost = 0
        if overrun:
            elapsed = (arrival_ns - self._last_ns) / self.period_ns if self._last_ns >= 0 else 0.0
            lost = max(1, round(elapsed) + self._left - n - left)
            self._line.restart()
        self._left = left
        out.n = n
        out.dt_ns = self.period_ns
        out.t0_ns = self._line.stamp(n, arrival_ns - left * self.period_ns)[0] if n else arrival_ns
        out.seq0 = self.next_seq + lost
        out.lost = lost
        out.source = TimeSource.DEVICE_CLOCK
        out.status = Status.OVERRUN if overrun else Status.OK if n else Status.STALE
        self.next_seq = out.seq0 + n
        self.lost += lost
        self._last_ns = arrival_ns


def imu_channels(
    name: str, setup: ImuSetup, temperature: tuple[float, float, float], field_range_T: Sequence[float] = ()
) -> Sequence[ChannelInfo]:
    """Return the channels of a sensor. ``temperature`` is lo, hi, step; ``field_range_T`` is (x, y, z, step) or
    empty."""
    accel = setup.accel_range_g * STANDARD_GRAVITY
    gyro = setup.gyro_range_dps * RAD_PER_DEG
    channels = [ChannelInfo(f"{name}.accel_{a}", "m/s^2", -accel, accel, setup.accel_lsb_mps2) for a in AXES]
    channels += [ChannelInfo(f"{name}.gyro_{a}", "rad/s", -gyro, gyro, setup.gyro_lsb_rad_s) for a in AXES]
    channels.append(ChannelInfo(f"{name}.temperature", "degC", *temperature))
    for axis, limit in zip(AXES, field_range_T, strict=False):
        channels.append(ChannelInfo(f"{name}.field_{axis}", "T", -limit, limit, field_range_T[3]))
    return channels


def offset_counts(wanted: Triple, step: float, lowest: int, highest: int, what: str, name: str) -> list[int]:
    """Return the offsets in register steps. Raises ``BenchError`` if one does not fit."""
    counts = [round(value / step) for value in wanted]
    for axis, count in zip(AXES, counts, strict=True):
        if not lowest <= count <= highest:
            raise BenchError(
                f"{what} offset of {axis} is {count} steps of {step:.3g}, the register holds {lowest} .. {highest}",
                device=name,
            )
    return counts


def require_mode(mode: Mode | None, wanted: Mode, name: str) -> None:
    """Raise ``BenchError`` unless the sensor was started in mode ``wanted``."""
    if mode != wanted:
        raise BenchError(f"started in mode {mode!r}; this call needs start(mode={wanted!r})", device=name)


class CountingImu:
    """Counts ``lost`` and ``stale`` samples since ``start`` of a chip that is read sample by sample or by its FIFO."""

    def __init__(self) -> None:
        self._counter = SampleCounter()
        self._timeline = FifoTimeline()
        self._mode: Mode | None = None

    @property
    def lost(self) -> int:
        return self._timeline.lost if self._mode == "fifo" else self._counter.lost

    @property
    def stale(self) -> int:
        return self._counter.stale
