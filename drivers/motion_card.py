"""Reads a motion card behind its scanner card: six axes, temperature and the activation button as text on a serial
line.

Source: Erat 2018, section 4.2; formats in ``drivers.motion_card_protocol``. The card's MPU-6050 runs
at 2 g, 2000 deg/s and 100 Hz. The line has no field for the battery: that level is only on the air (4.3.2).
"""

from __future__ import annotations

from collections import deque
from collections.abc import Sequence

import numpy as np

from drivers.imu.base import RAD_PER_DEG, ImuSample
from drivers.motion_card_protocol import CardReading, Fields, LineParser, SpikeFilter, line_bytes, to_si
from drivers.options import MotionCardOptions
from drivers.registry import Driver, Load, Traffic
from hal.contracts import Clock, SerialPort
from hal.errors import HalTimeout, WrongDevice
from hal.types import STANDARD_GRAVITY, ChannelInfo, Status, TimeSource
from hal.wire_bits import serial_bits

ACCEL_RANGE_G = 2.0
GYRO_RANGE_DPS = 2000.0
ACCEL_LSB_MPS2 = STANDARD_GRAVITY / 16384.0
GYRO_LSB_RAD_S = RAD_PER_DEG / 16.4
TEMPERATURE_STEP_C = 1.0 / 340.0
QUEUE_LIMIT = 256
READ_BYTES = 4096
PROBE_TRIES = 8


class CardQueue:
    """Queues readings, in SI units with time and status, of cards on a serial line or over Bluetooth.

    ``card_status`` is that of the sample that was read last. A message carries only the button's result, so the spike
    filter takes every change of status for a release: for 20 ms after it samples are ``Status.STALE`` and repeat the
    last one.
    """

    def __init__(self, rate_hz: float, fields: Fields, *, spike_filter: bool) -> None:
        self.card_status = 0
        self.lost = 0
        self.stale = 0
        self.clicks = 0
        self.spikes = SpikeFilter() if spike_filter else None
        self._period_ns = round(1e9 / rate_hz)
        self._raw = fields == "raw"
        self._convert = to_si(fields, ACCEL_LSB_MPS2, GYRO_LSB_RAD_S)
        self._waiting: deque[tuple[int, CardReading]] = deque()
        self._dropped = 0
        self._seq = -1
        self._t_ns = 0
        self._values = [float("nan")] * 7
        self._counts = (0.0,) * 7

    def __len__(self) -> int:
        return len(self._waiting)

    def put(self, readings: Sequence[CardReading], arrival_ns: int) -> None:
        """Queue readings that arrived together at ``arrival_ns``.

        They are stamped one period apart, the last one with ``arrival_ns``."""
        for i, reading in enumerate(readings):
            self._waiting.append((arrival_ns - (len(readings) - 1 - i) * self._period_ns, reading))
        while len(self._waiting) > QUEUE_LIMIT:
            self._waiting.popleft()
            self._dropped += 1

    def take(self, out: ImuSample) -> Status:
        """Move the oldest reading into ``out`` and return its status. Without one, repeat the last one as ``STALE``."""
        status = Status.STALE
        out.lost = 0
        if self._waiting:
            t_ns, reading = self._waiting.popleft()
            out.lost, self._dropped = self._dropped, 0
            self.lost += out.lost
            first = self._seq < 0
            self._seq += 1 + out.lost
            self._t_ns = t_ns
            status = Status.OVERRUN if out.lost else Status.OK
            changed = not first and reading.status != self.card_status
            self.card_status = reading.status
            self.clicks += changed
            if self.spikes is None or self.spikes.admit(changed, t_ns):
                self._values = self._convert(reading)
                self._counts = reading.values if self._raw else self._counts  # scaled text carries no counts
                if max(reading.values[:6]) >= 32767 or min(reading.values[:6]) <= -32768:
                    status |= Status.SATURATED
            else:
                status |= Status.STALE
        else:
            self.stale += 1
        out.accel_mps2[:] = self._values[:3]
        out.gyro_rad_s[:] = self._values[3:6]
        out.field_T[:] = np.nan
        out.temperature_C = self._values[6]
        out.raw[:] = np.trunc(self._counts)
        out.t_ns = self._t_ns
        out.seq = self._seq
        out.source = TimeSource.HOST
        out.status = status
        return status


class QueuedCard:
    """Gives serial and BLE cards the access to their queue; it is the base of the motion card drivers."""

    def __init__(self, name: str, rate_hz: float, fields: Fields, *, spike_filter: bool) -> None:
        self.name = name
        self._queue = CardQueue(rate_hz, fields, spike_filter=spike_filter)

    @property
    def card_status(self) -> int:
        """Return the status in the sample read last: 0 inactive, 1 rotate, 2 zoom."""
        return self._queue.card_status

    @property
    def clicks(self) -> int:
        """Return the number of changes of the card's status so far."""
        return self._queue.clicks

    @property
    def lost(self) -> int:
        """Return the number of readings that were discarded because ``read`` was not called in time. Messages that
        could not be decoded are counted in ``bad_frames``."""
        return self._queue.lost

    @property
    def stale(self) -> int:
        return self._queue.stale

    @property
    def masked(self) -> int:
        """Return the number of samples that the spike filter held back."""
        return self._queue.spikes.held if self._queue.spikes else 0

    def waiting(self) -> int:
        """Return the number of readings that have arrived and that ``read`` has not returned."""
        return len(self._queue)

    def channels(self) -> Sequence[ChannelInfo]:
        return card_channels(self.name)


class MotionCard(QueuedCard):
    """Reads the scanner card's serial port. Call ``read`` at least at ``rate_hz``; it never waits."""

    def __init__(
        self,
        port: SerialPort,
        clock: Clock,
        *,
        rate_hz: float = 100.0,
        fields: Fields = "raw",
        spike_filter: bool = True,
        name: str = "card",
    ) -> None:
        super().__init__(name, rate_hz, fields, spike_filter=spike_filter)
        self.parser = LineParser(fields)
        self._port = port
        self._clock = clock
        self._buf = memoryview(bytearray(READ_BYTES))

    @property
    def bad_frames(self) -> int:
        """Return the number of malformed lines since the first good one."""
        return self.parser.bad_frames

    def probe(self, limit_s: float = 1.0) -> str:
        """Wait for a good line. Raises ``HalTimeout`` if nothing comes, ``WrongDevice`` if something else comes."""
        limit_ns = self._clock.now_ns() + round(limit_s * 1e9)
        while self.parser.frames == 0:
            left_s = (limit_ns - self._clock.now_ns()) * 1e-9
            if left_s > 0:
                self._receive(left_s)
            if self.parser.bad_frames > PROBE_TRIES or (left_s <= 0 and self.parser.discarded_bytes):
                raise WrongDevice(
                    "what arrives are not lines '#:ax:ay:az:wx:wy:wz:temperature:status:'; check port and baud rate",
                    device=self.name,
                )
            if left_s <= 0:
                raise HalTimeout(
                    f"no line within {limit_s} s; is the card switched on and in reach of the scanner?",
                    device=self.name,
                )
        return "motion card"

    def read(self, out: ImuSample) -> Status:
        """Return the oldest unread reading, or the last one with ``STALE`` when the queue is empty."""
        self._receive(0.0)
        return self._queue.take(out)

    def close(self) -> None:
        self._port.close()

    def _receive(self, timeout_s: float) -> None:
        n = self._port.read_into(self._buf, timeout_s)
        if n:
            self._queue.put(self.parser.feed(self._buf[:n]), self._clock.now_ns())


def card_channels(name: str) -> Sequence[ChannelInfo]:
    """Return the channels of the card, for serial and BLE alike."""
    accel, gyro = ACCEL_RANGE_G * STANDARD_GRAVITY, GYRO_RANGE_DPS * RAD_PER_DEG
    channels = [ChannelInfo(f"{name}.accel_{a}", "m/s^2", -accel, accel, ACCEL_LSB_MPS2) for a in "xyz"]
    channels += [ChannelInfo(f"{name}.gyro_{a}", "rad/s", -gyro, gyro, GYRO_LSB_RAD_S) for a in "xyz"]
    channels.append(ChannelInfo(f"{name}.temperature", "degC", -40.0, 85.0, TEMPERATURE_STEP_C))
    channels.append(ChannelInfo(f"{name}.status", "1", 0.0, 2.0, 1.0))
    return channels


def _traffic(load: Load) -> list[Traffic]:
    return [Traffic("line", serial_bits(line_bytes(load.options.fields)), load.options.rate_hz)]


DRIVER = Driver(MotionCardOptions, role="inertial", traffic=_traffic)
