"""Values that take the place of the physics at the inputs of emulated parts: constants and recorded columns.

A channel is named ``part.channel``: ``daq.0`` is input 0 of the part ``daq`` in V, ``imu.ax`` the specific force along
the x axis of the part ``imu`` in m/s^2. A channel without a stimulus shows what the plant gives.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np

from hal.arrays import Array
from sim_devices.faces import VoltageSource, Volts
from sim_devices.plant.body_motion import BodyMotion, MotionSource, Mount

Source = Callable[[int], float]  # bench time in ns -> value
AXES = ("ax", "ay", "az", "gx", "gy", "gz", "mx", "my", "mz", "temperature")
MOTION_UNITS = dict(zip(AXES, ("m/s^2",) * 3 + ("rad/s",) * 3 + ("uT",) * 3 + ("degC",), strict=True))


class UnknownChannel(ValueError):
    """There is no such part or channel."""


class Stimuli:
    """Holds all channels of a world. ``units`` maps the name of each channel to its unit."""

    def __init__(self) -> None:
        self.units: dict[str, str] = {}
        self._put: dict[str, Source] = {}
        self._look: dict[str, Source] = {}
        self._read: dict[str, Callable[[], Sequence[float]]] = {}

    # ------------------------------------------------------------------ for who sets and reads them

    def check(self, channel: str) -> None:
        """Raise ``UnknownChannel`` unless ``channel`` can be set."""
        if channel not in self._look:
            raise UnknownChannel(self._unknown(channel))

    def put(self, channel: str, source: Source | None) -> None:
        """Let ``source`` take the place of the plant at ``channel``; ``None`` ends that. Raises ``UnknownChannel``."""
        self.check(channel)
        if source is None:
            self._put.pop(channel, None)
        else:
            self._put[channel] = source

    def read(self, name: str, t_ns: int) -> dict[str, float]:
        """Return the present value of a channel, of all channels of a part, or (``""``) of all parts.

        Raises ``UnknownChannel``."""
        values: dict[str, float] = {}
        for channel in self.units:
            part = channel.rpartition(".")[0]
            if name in ("", channel, part):
                values[channel] = self._value(channel, part, t_ns)
        if not values:
            raise UnknownChannel(self._unknown(name))
        return values

    def _value(self, channel: str, part: str, t_ns: int) -> float:
        if channel in self._look:
            return float(self._put.get(channel, self._look[channel])(t_ns))
        return float(self._read[part]()[int(channel.rpartition(".out")[2])])

    def _unknown(self, name: str) -> str:
        part = name.rpartition(".")[0]
        near = [c for c in self.units if c.startswith(f"{part}.") or c.startswith(f"{name}.")] or list(self.units)
        if name in self.units:
            return f"'{name}' is an output of the part; it can be read, not set"
        return f"there is no channel '{name}'; channels are {', '.join(near)}"

    # ------------------------------------------------------------------ for the world

    def volts(self, part: str, source: VoltageSource, count: int) -> VoltageSource:
        """``source`` with what is put at ``part.0`` to ``part.(count - 1)``, in V."""
        names = [f"{part}.{i}" for i in range(count)]
        for i, name in enumerate(names):
            self.units[name] = "V"
            self._look[name] = lambda t_ns, i=i: float(source(t_ns)[i])

        def volts(t_ns: int) -> Volts:
            sensed = source(t_ns)
            if not self._put:
                return sensed
            return np.array([self._put[n](t_ns) if n in self._put else v for n, v in zip(names, sensed, strict=True)])

        return volts

    def axis(self, part: str, source: Callable[[int, int], float]) -> Callable[[int, int], float]:
        """``source(axis, t_ns)`` with what is put at ``part.position1`` to ``part.position3``, in um."""
        names = [f"{part}.position{axis + 1}" for axis in range(3)]
        for axis, name in enumerate(names):
            self.units[name] = "um"
            self._look[name] = lambda t_ns, axis=axis: source(axis, t_ns)

        def position_um(axis: int, t_ns: int) -> float:
            put = self._put.get(names[axis])
            return source(axis, t_ns) if put is None else put(t_ns)

        return position_um

    def motion(self, part: str, source: MotionSource, mount: Mount) -> MotionSource:
        """``source`` with what is put at ``part.ax`` and the other ``AXES``, along the axes of the sensor on ``mount``.

        Where anything is put, the motion that is returned has its origin at the sensor, so that no lever arm adds to
        it."""
        names = [f"{part}.{axis}" for axis in AXES]

        def felt(motion: BodyMotion) -> list[float]:
            force, rate = mount.felt(motion)
            return [*force, *rate, *mount.field_uT(motion), motion.temperature_C]

        for i, (axis, name) in enumerate(zip(AXES, names, strict=True)):
            self.units[name] = MOTION_UNITS[axis]
            self._look[name] = lambda t_ns, i=i: felt(source(t_ns))[i]

        def motion(t_ns: int) -> BodyMotion:
            now = source(t_ns)
            if not self._put or self._put.keys().isdisjoint(names):
                return now
            values = felt(now)
            for i, name in enumerate(names):
                if name in self._put:
                    values[i] = self._put[name](t_ns)
            turn = mount.turn
            return BodyMotion(
                now.attitude,
                turn @ np.array(values[3:6]),
                turn @ np.array(values[:3]),
                origin_m=mount.position_m,
                field_world_uT=now.attitude @ turn @ np.array(values[6:9]),
                temperature_C=values[9],
            )

        return motion

    def outputs(self, part: str, read: Callable[[], Sequence[float]], count: int) -> None:
        """Name the outputs of ``part``, ``part.out0`` and so on in V, which can be read."""
        self._read[part] = read
        for i in range(count):
            self.units[f"{part}.out{i}"] = "V"


def played(t_s: Sequence[float] | Array, values: Sequence[float] | Array, start_ns: int) -> Source:
    """Return a column as a source: straight lines between samples, the first and last value outside them.

    ``t_s`` (n,) in s rises and is counted from ``start_ns``; ``values`` (n,). Raises ``UnknownChannel`` for a column
    that cannot be played.
    """
    times, column = np.asarray(t_s, dtype=np.float64), np.asarray(values, dtype=np.float64)
    if times.ndim != 1 or times.shape != column.shape or not len(times):
        raise UnknownChannel(f"times {times.shape} and values {column.shape} must be columns of one length")
    if not (np.isfinite(times).all() and np.isfinite(column).all() and (np.diff(times) > 0).all()):
        raise UnknownChannel("times must rise, and times and values must be finite")

    def value(t_ns: int) -> float:
        return float(np.interp((t_ns - start_ns) * 1e-9, times, column))

    return value


def constant(value: float) -> Source:
    """Return ``value`` as a source."""
    return lambda t_ns: value
