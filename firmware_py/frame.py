"""The frame: one preallocated float64 vector that a tick fills from left to right.

Every stage reads columns to its left and writes its own; the recorder copies the vector, replay refills it.
Column starts are plain integers (``frame[RATE + 1]``), because compiled kernels need constants.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from enum import IntFlag
from typing import Any

import numpy as np
from numpy.typing import NDArray

XYZ = ("x", "y", "z")
AXES = ("1x", "1z", "2y", "2z", "3x", "3y")  # sensor order, Ang 2004 (2.34)
MORE_AXES = ("7", "8")  # the converter has eight inputs
PARITIES = ("1", "2")


@dataclass(frozen=True, slots=True)
class Column:
    """Describes one quantity of the frame: ``parts`` names its scalars (empty for a scalar quantity)."""

    name: str
    unit: str
    parts: tuple[str, ...]
    what: str
    start: int

    @property
    def size(self) -> int:
        return max(1, len(self.parts))

    @property
    def span(self) -> slice:
        return slice(self.start, self.start + self.size)

    def scalar_names(self) -> tuple[str, ...]:
        """Return ``name_part`` for every scalar, or the bare name."""
        return tuple(f"{self.name}_{part}" for part in self.parts) or (self.name,)


_CHANNELS = tuple(str(i) for i in range(8))
_QUANTITIES: tuple[tuple[str, str, tuple[str, ...], str], ...] = (
    ("tick", "1", (), "device sequence number of the scan"),
    ("t", "s", (), "bench time of the scan since the start of the run"),
    ("counts", "count", _CHANNELS, "raw converter counts, in scan order"),
    ("magnetometer_raw", "V", XYZ, "magnetometer outputs, last conversion"),
    ("magnetometer_fresh", "1", (), "1 when the magnetometer was converted since the last tick"),
    ("volts", "V", _CHANNELS, "converter inputs"),
    ("supply", "V", (), "supply of the accelerometers, behind the same low-pass as their outputs"),
    ("temperature", "degC", (), "temperature of the sensor suite, smoothed"),
    ("accelerometer", "m/s^2", AXES, "calibrated readings, specific force along each sensor's axis"),
    ("accelerometer_more", "m/s^2", MORE_AXES, "axes beyond six, 0 where there are none"),
    ("parity", "1", PARITIES, "what more than six axes contradict, in deviations of a sample's noise; 0 with six"),
    ("magnetometer", "uT", XYZ, "magnetic field, body frame"),
    ("specific_force", "m/s^2", XYZ, "specific force at the origin of the body frame"),
    ("angular_acceleration", "rad/s^2", XYZ, "body frame, bias removed"),
    ("rate", "rad/s", XYZ, "angular rate, body frame"),
    ("quaternion", "1", ("w", "x", "y", "z"), "attitude, body to world, w >= 0"),
    ("tip_acceleration", "m/s^2", XYZ, "acceleration of the tip, body frame, no gravity, behind the sensor filter"),
    ("tip_displacement", "m", XYZ, "displacement in the tremor band, body frame, phase: translation.py"),
    ("tremor", "m", XYZ, "estimated tremor of the tip now, body frame"),
    ("tremor_ahead", "m", XYZ, "tremor predicted over the loop's delay, body frame"),
    ("tremor_core", "m", XYZ, "the part of tremor_ahead that does not yield when the stroke runs out, body frame"),
    ("tremor_frequency", "Hz", XYZ, "tracked frequency"),
    ("tremor_amplitude", "m", XYZ, "amplitude of the estimated tremor"),
    ("confidence", "1", XYZ, "0 not settled .. 1 the estimate explains the signal"),
    ("desired_tip", "m", XYZ, "wanted displacement of the tip, manipulator frame"),
    ("stroke", "m", ("1", "2", "3"), "wanted actuator strokes from neutral; actuation/stage.py turns them into volts"),
    ("command", "V", ("1", "2", "3"), "amplifier output voltages; the driver divides by the gain"),
    ("clip", "bits", (), "Clip"),
    ("status", "bits", (), "FrameStatus"),
)


class FrameStatus(IntFlag):
    """Condition of a tick. The bits of the scan are set before the kernels run, the others by them."""

    OK = 0
    GAP = 1  # scans are missing before this one (scan)
    STALE = 2  # no new scan, the last one is repeated (scan)
    SATURATED = 4  # an accelerometer is beyond its range
    INVALID = 8  # a reading is not finite: the stages coast on their models
    ALIGNING = 16  # attitude not initialised yet
    SETTLING = 32  # estimator not settled, nothing is commanded yet
    RESTARTED = 64  # a gap was too long to coast over: alignment starts again
    COMMANDED = 128  # the newest scan of its tick, and the outputs were free to move: a command was computed
    MANUAL = 256  # the command was chosen by hand (bench page), not computed
    JERK = 512  # the hand twitches: a burst between voluntary motion and tremor
    DRIFT = 1024  # acceleration has stayed away from zero: bias or attitude drifts
    FALLBACK = 2048  # the chosen kinematics could not be used: this tick is the other one's solution
    HELD = 4096  # a hold: the command is the ramp to neutral, or neutral (loop)


class Clip(IntFlag):
    """Limits that the actuation stage ran into in this tick."""

    NONE = 0
    WORKSPACE = 1  # the wanted displacement is out of reach: the nearest reachable one is commanded
    VOLTAGE = 2  # the command was limited to the amplifier's range
    SLEW = 4  # the command moved as far as the amplifier can in one tick
    SINGULAR = 8  # so fast that a slope of the hysteresis model had to be kept positive
    YIELD = 16  # slow motion was scaled down so that the tremor keeps its stroke: no limit was met


class Layout:
    """Describes the frame of one instrument; ``layout["rate"]`` is a slice. ``quantities`` lists name, unit, parts and
    meaning of each, from left to right. ``plotted`` names the quantities that a scope shows first; ``held`` is the
    column, and the bits in it, that say that a hold keeps the instrument at rest."""

    def __init__(
        self,
        instrument: str,
        quantities: Iterable[tuple[str, str, tuple[str, ...], str]],
        *,
        plotted: tuple[str, ...],
        held: tuple[str, int],
    ) -> None:
        self.instrument = instrument
        self.plotted = plotted
        self._held_in, self._held_bits = held
        columns: list[Column] = []
        start = 0
        for name, unit, parts, what in quantities:
            columns.append(Column(name, unit, parts, what, start))
            start = columns[-1].span.stop
        self.columns: tuple[Column, ...] = tuple(columns)
        self.size: int = start
        self._by_name = {column.name: column for column in columns}

    def __getitem__(self, name: str) -> slice:
        return self._by_name[name].span

    def __iter__(self) -> Iterator[Column]:
        return iter(self.columns)

    def start(self, name: str) -> int:
        return self._by_name[name].start

    def unit(self, name: str) -> str:
        return self._by_name[name].unit

    def scalar_names(self) -> tuple[str, ...]:
        """Return one name per element of the frame, in order."""
        return tuple(name for column in self.columns for name in column.scalar_names())

    def scalar_units(self) -> tuple[str, ...]:
        """Return one unit per element of the frame, in order."""
        return tuple(column.unit for column in self.columns for _ in range(column.size))

    def find_column(self, scalar: str) -> Column | None:
        """Return the quantity that the scalar ``scalar`` belongs to, ``None`` where the frame has none."""
        return next((column for column in self.columns if scalar in column.scalar_names()), None)

    def read_holds(self, names: Sequence[str], rows: NDArray[np.floating[Any]]) -> NDArray[np.bool_]:
        """Return for each row (last axis of ``rows`` is the column ``names``) whether a hold lasts in it.

        A value that is not finite, and a recording without the column, say that none does."""
        if self._held_in not in names:
            return np.zeros(len(rows), dtype=np.bool_)
        values = rows[:, names.index(self._held_in)]
        words = np.where(np.isfinite(values), values, 0.0).astype(np.int64)
        return np.asarray((words & self._held_bits) != 0)

    def new_frame(self) -> NDArray[np.float64]:
        """Return a frame of zeros."""
        return np.zeros(self.size)


LAYOUT = Layout("micron", _QUANTITIES, plotted=("tip_displacement", "command"), held=("status", int(FrameStatus.HELD)))

TICK = LAYOUT.start("tick")
TIME = LAYOUT.start("t")
COUNTS = LAYOUT.start("counts")
MAGNETOMETER_RAW = LAYOUT.start("magnetometer_raw")
MAGNETOMETER_FRESH = LAYOUT.start("magnetometer_fresh")
VOLTS = LAYOUT.start("volts")
SUPPLY = LAYOUT.start("supply")
TEMPERATURE = LAYOUT.start("temperature")
ACCELEROMETER = LAYOUT.start("accelerometer")
ACCELEROMETER_MORE = LAYOUT.start("accelerometer_more")
PARITY = LAYOUT.start("parity")
MAGNETOMETER = LAYOUT.start("magnetometer")
SPECIFIC_FORCE = LAYOUT.start("specific_force")
ANGULAR_ACCELERATION = LAYOUT.start("angular_acceleration")
RATE = LAYOUT.start("rate")
QUATERNION = LAYOUT.start("quaternion")
TIP_ACCELERATION = LAYOUT.start("tip_acceleration")
TIP_DISPLACEMENT = LAYOUT.start("tip_displacement")
TREMOR = LAYOUT.start("tremor")
TREMOR_AHEAD = LAYOUT.start("tremor_ahead")
TREMOR_CORE = LAYOUT.start("tremor_core")
TREMOR_FREQUENCY = LAYOUT.start("tremor_frequency")
TREMOR_AMPLITUDE = LAYOUT.start("tremor_amplitude")
CONFIDENCE = LAYOUT.start("confidence")
DESIRED_TIP = LAYOUT.start("desired_tip")
STROKE = LAYOUT.start("stroke")
COMMAND = LAYOUT.start("command")
CLIP = LAYOUT.start("clip")
STATUS = LAYOUT.start("status")
SIZE = LAYOUT.size

STALE = int(FrameStatus.STALE)
SATURATED = int(FrameStatus.SATURATED)
INVALID = int(FrameStatus.INVALID)
ALIGNING = int(FrameStatus.ALIGNING)
SETTLING = int(FrameStatus.SETTLING)
RESTARTED = int(FrameStatus.RESTARTED)
JERK = int(FrameStatus.JERK)
DRIFT = int(FrameStatus.DRIFT)
FALLBACK = int(FrameStatus.FALLBACK)
CLIP_WORKSPACE = int(Clip.WORKSPACE)
CLIP_VOLTAGE = int(Clip.VOLTAGE)
CLIP_SLEW = int(Clip.SLEW)
CLIP_SINGULAR = int(Clip.SINGULAR)
CLIP_YIELD = int(Clip.YIELD)
