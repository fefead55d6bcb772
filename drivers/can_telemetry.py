"""Sends telemetry frames and receives the stop button over CAN (``drivers/dbc/micron.dbc``)."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence

from drivers.can_frames import HostHeartbeat, host_heartbeat
from drivers.dbc import load_database
from drivers.options import CanTelemetryOptions
from drivers.registry import Driver, Load, Traffic
from hal.contracts import CanBus, Clock
from hal.types import CanFrame, ChannelInfo
from hal.wire_bits import can_bits

BUTTON_LIMIT_NS = 1_500_000_000  # three heartbeats of the button
RECEIVE_LIMIT = 32
BUTTON_HZ = 10.0  # while it is pressed; 2 Hz otherwise (micron.dbc)
FRAMES = {"TELEMETRY_TREMOR": 8, "TELEMETRY_STATE": 8, "STOP_BUTTON": 2}
"""Data bytes of the repeated frames: the first two are sent by ``send_tremor`` and ``send_state``, the last by the
button."""


class CanTelemetry:
    """Sends telemetry and watches the stop button. ``poll``, called at the supervisor's rate, also sends the host's
    heartbeat."""

    def __init__(
        self, bus: CanBus, clock: Clock, *, heartbeat: HostHeartbeat | None = None, name: str = "telemetry"
    ) -> None:
        database = load_database()
        self.name = name
        self.stop_pressed = False
        self.presses = 0
        self.button_ns = 0
        self.sent = 0
        self.heartbeat = heartbeat or HostHeartbeat(bus, clock, database)
        self._bus = bus
        self._clock = clock
        self._tremor = database.get_message_by_name("TELEMETRY_TREMOR")
        self._state = database.get_message_by_name("TELEMETRY_STATE")
        self._button = database.get_message_by_name("STOP_BUTTON")

    @staticmethod
    def receives() -> tuple[int, ...]:
        """Return the CAN ids that it receives, for ``SharedCan.view``."""
        return (load_database().get_message_by_name("STOP_BUTTON").frame_id,)

    def poll(self) -> bool:
        """Process the frames that have arrived. Return True while the stop button is pressed. Never waits."""
        self.heartbeat.beat()
        for _ in range(RECEIVE_LIMIT):
            frame = self._bus.recv(0.0)
            if frame is None:
                break
            if frame.can_id == self._button.frame_id and len(frame.data) == self._button.length:
                pressed = frame.data[0] != 0  # anything but a clear 'released' stops
                self.presses += pressed and not self.stop_pressed
                self.stop_pressed = pressed
                self.button_ns = frame.t_ns
        return self.stop_pressed

    def button_silent(self) -> bool:
        """Return True if no frame of the button has come for 1.5 s, so that it could not stop anything."""
        return self.button_ns == 0 or self._clock.now_ns() - self.button_ns > BUTTON_LIMIT_NS

    def send_tremor(self, amplitude_um: Sequence[float], frequency_Hz: float) -> None:
        """Send the tremor amplitude (3,) in um and the frequency in Hz, limited to the range of the frame."""
        x, y, z = amplitude_um
        self._send(
            self._tremor.frame_id,
            self._tremor.encode(
                {
                    "amplitude_x": _within(x, 6553.5),
                    "amplitude_y": _within(y, 6553.5),
                    "amplitude_z": _within(z, 6553.5),
                    "frequency": _within(frequency_Hz, 655.35),
                },
                strict=False,
            ),
        )

    def send_state(self, state: int, flags: int, lost_samples: int, skipped_ticks: int, worst_tick_us: float) -> None:
        """Send the state of the loop: supervisor's state, status bits of the frame, counters up to 65535, and the
        longest tick in us."""
        self._send(
            self._state.frame_id,
            self._state.encode(
                {
                    "state": state & 0xFF,
                    "flags": flags & 0xFF,
                    "lost_samples": min(lost_samples, 0xFFFF),
                    "skipped_ticks": min(skipped_ticks, 0xFFFF),
                    "worst_tick": round(_within(worst_tick_us, 65535.0)),
                },
                strict=False,
            ),
        )

    def channels(self) -> Sequence[ChannelInfo]:
        return [ChannelInfo(f"{self.name}.stop", "1", 0.0, 1.0, 1.0)]

    def _send(self, can_id: int, data: bytes) -> None:
        self._bus.send(CanFrame(can_id, data), 0.0)
        self.sent += 1


def _within(value: float, top: float) -> float:
    return min(max(value, 0.0), top) if math.isfinite(value) else top


def _traffic(load: Load) -> Iterator[Traffic]:
    polls = load.polling.telemetry
    sent_hz = polls.per_s(load.tick_hz) if polls is not None else 0.0
    for frame, n in FRAMES.items():
        yield Traffic(frame, can_bits(n), BUTTON_HZ if frame == "STOP_BUTTON" else sent_hz)
    yield host_heartbeat()


DRIVER = Driver(CanTelemetryOptions, role="node", traffic=_traffic)
