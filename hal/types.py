"""Defines the values that cross the hardware boundary: samples, frames, transfers, and the source of their time."""

from __future__ import annotations

from dataclasses import dataclass, field
from enum import Enum, IntFlag

STANDARD_GRAVITY = 9.80665
"""m/s^2 in one g, as data sheets and files count it."""


class TimeSource(Enum):
    """Names the clock that stamped a sample."""

    DEVICE_CLOCK = "device clock"
    KERNEL = "kernel"
    HOST = "host"
    SIMULATION = "simulation"


class Status(IntFlag):
    """Flags the condition of a sample. Ordinary trouble is reported here and not as an exception."""

    OK = 0
    OVERRUN = 1
    SATURATED = 2
    GAP = 4
    STALE = 8
    SHIFTED = 16
    """Scans arrive at another time than the device's clock says: it stepped, or the transport became slower."""


@dataclass(frozen=True, slots=True)
class ChannelInfo:
    """Describes one measured quantity: ``lo``..``hi`` is the range and ``epsilon`` the resolution, all in ``unit``."""

    name: str
    unit: str
    lo: float
    hi: float
    epsilon: float


@dataclass(frozen=True, slots=True)
class ScanConfig:
    """Asks for hardware-timed scans: ``channels`` in scan order, full scale ``range_V`` (V) per channel."""

    rate_hz: float
    channels: tuple[int, ...]
    range_V: tuple[float, ...]


@dataclass(frozen=True, slots=True)
class ScanInfo:
    """Holds the settings that a DAQ really uses: rate, full scale and step per channel, FIFO depth in scans."""

    rate_hz: float
    channels: tuple[int, ...]
    range_V: tuple[float, ...]
    lsb_V: tuple[float, ...]
    buffer_scans: int
    simultaneous: bool


@dataclass(slots=True)
class ScanBlock:
    """Describes the scans that one call of ``read_scans`` delivered.

    It delivered ``n`` scans that were taken ``dt_ns`` apart, the first at ``t0_ns`` (bench clock) with the device
    sequence number ``seq0``; ``lost`` scans are known to be missing before the first one.
    """

    n: int
    t0_ns: int
    dt_ns: int
    seq0: int
    source: TimeSource
    status: Status = Status.OK
    lost: int = 0


@dataclass(frozen=True, slots=True)
class I2cWrite:
    """Describes one write segment of an I2C transfer."""

    data: bytes


@dataclass(frozen=True, slots=True)
class I2cRead:
    """Describes one read segment of ``n`` bytes of an I2C transfer."""

    n: int


I2cOp = I2cWrite | I2cRead


@dataclass(frozen=True, slots=True)
class CanFrame:
    """Holds a CAN data frame. ``t_ns`` is the bench time of reception (0 when not yet sent)."""

    can_id: int
    data: bytes
    extended: bool = False
    t_ns: int = 0
    source: TimeSource = TimeSource.HOST


@dataclass(slots=True)
class CanStats:
    """Counts the frames of a CAN adapter since it was opened."""

    rx: int = 0
    tx: int = 0
    dropped: int = 0
    error_frames: int = 0


@dataclass(frozen=True, slots=True)
class OutputLimit:
    """Limits one analog output channel. The channel rests at ``safe_V`` when nothing commands it."""

    lo_V: float
    hi_V: float
    slew_V_per_s: float
    safe_V: float


@dataclass(frozen=True, slots=True)
class PortInfo:
    """Describes an adapter in reports. ``emulated`` is information for people; no code branches on it."""

    uri: str
    description: str
    emulated: bool
    details: dict[str, str] = field(default_factory=dict[str, str])
