"""Reads a motion card without its scanner card: 15-byte packets and battery level over Bluetooth Low Energy.

Source: Erat 2018, 4.3.2 (services and characteristics) and Fig. 4.13. Tested against a stand-in for
the Bluetooth stack, never yet against a radio.
"""

from __future__ import annotations

from drivers.imu.base import ImuSample
from drivers.motion_card import QueuedCard
from drivers.motion_card_protocol import (
    BATTERY_CHARACTERISTIC,
    IMU_CHARACTERISTIC,
    decode_battery,
    decode_packet,
)
from drivers.options import BleMotionCardOptions
from drivers.registry import Driver
from hal.contracts import Clock, GattClient
from hal.errors import HalTimeout, ProtocolError
from hal.types import Status

RECEIVE_LIMIT = 64


class BleMotionCard(QueuedCard):
    """Reads one card. ``probe`` subscribes; ``read`` returns the oldest unread sample and never waits."""

    def __init__(
        self,
        link: GattClient,
        clock: Clock,
        *,
        rate_hz: float = 100.0,
        spike_filter: bool = True,
        timeout_s: float = 5.0,
        name: str = "card",
    ) -> None:
        super().__init__(name, rate_hz, "raw", spike_filter=spike_filter)
        self.battery_percent: int | None = None
        self.frames = 0
        self.bad_frames = 0
        self._link = link
        self._clock = clock
        self._timeout_s = timeout_s

    def probe(self) -> str:
        """Read the battery, switch both notifications on, and wait for a good packet. Raises ``HalTimeout`` if none
        comes."""
        try:
            self.battery_percent = decode_battery(self._link.read(BATTERY_CHARACTERISTIC, self._timeout_s))
        except ValueError as error:
            raise ProtocolError(str(error), device=self.name) from error
        self._link.subscribe(BATTERY_CHARACTERISTIC, self._timeout_s)
        self._link.subscribe(IMU_CHARACTERISTIC, self._timeout_s)
        limit_ns = self._clock.now_ns() + round(self._timeout_s * 1e9)
        while self.frames == 0:
            left_s = (limit_ns - self._clock.now_ns()) * 1e-9
            if left_s <= 0:
                raise HalTimeout(f"no packet within {self._timeout_s} s", device=self.name)
            self._receive(left_s)
        return f"motion card, battery {self.battery_percent} %"

    def read(self, out: ImuSample) -> Status:
        for _ in range(RECEIVE_LIMIT):
            if not self._receive(0.0):
                break
        return self._queue.take(out)

    def close(self) -> None:
        self._link.close()

    def _receive(self, timeout_s: float) -> bool:
        item = self._link.receive(timeout_s)
        if item is None:
            return False
        characteristic, value, t_ns = item
        try:
            if characteristic == IMU_CHARACTERISTIC:
                self._queue.put([decode_packet(value)], t_ns)
                self.frames += 1
            elif characteristic == BATTERY_CHARACTERISTIC:
                self.battery_percent = decode_battery(value)
        except ValueError:
            self.bad_frames += 1
        return True


DRIVER = Driver(BleMotionCardOptions, role="inertial", needs="")
