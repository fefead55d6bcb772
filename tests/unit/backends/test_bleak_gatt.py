"""The Bluetooth adapter against a stand-in for the ``bleak`` package: no radio was ever asked."""

from __future__ import annotations

import sys
import types
from collections.abc import Callable

import pytest

from hal.backends.bleak_gatt import BleakGatt
from hal.clock import VirtualClock
from hal.errors import BusError, Closed, DeviceNotFound, Disconnected, HalError

NAME = "CONTROL.CMR"
KNOWN = "bf470002-767b-467d-a4c0-e8e050c0d96e"


class BleakError(Exception):
    pass


class Services:
    def get_characteristic(self, uuid: str) -> object | None:
        return object() if uuid == KNOWN else None


class Client:
    """What the adapter uses of ``bleak.BleakClient``."""

    def __init__(self, device: str, disconnected_callback: Callable[[object], None]) -> None:
        self.device = device
        self.lose = disconnected_callback
        self.services = Services()
        self.notify: Callable[[object, bytearray], None] | None = None
        self.connected = False
        self.refuse = False

    async def connect(self) -> None:
        self.connected = True

    async def disconnect(self) -> None:
        self.connected = False

    async def start_notify(self, uuid: str, callback: Callable[[object, bytearray], None]) -> None:
        self.notify = callback

    async def read_gatt_char(self, uuid: str) -> bytearray:
        if self.refuse:
            raise BleakError("refused")
        return bytearray(b"\x25")


class Scanner:
    @staticmethod
    async def find_device_by_name(name: str, timeout: float) -> str | None:
        return name if name == NAME else None

    @staticmethod
    async def find_device_by_address(address: str, timeout: float) -> str | None:
        return address


@pytest.fixture
def clients(monkeypatch: pytest.MonkeyPatch) -> list[Client]:
    made: list[Client] = []

    def client(device: str, disconnected_callback: Callable[[object], None]) -> Client:
        made.append(Client(device, disconnected_callback))
        return made[-1]

    fake = types.SimpleNamespace(
        BleakScanner=Scanner, BleakClient=client, exc=types.SimpleNamespace(BleakError=BleakError)
    )
    monkeypatch.setitem(sys.modules, "bleak", fake)
    return made


def test_notifications_arrive_in_order_with_their_time(clients: list[Client]):
    clock = VirtualClock(7)
    link = BleakGatt(NAME, clock)
    link.subscribe(KNOWN, 1.0)
    assert link.receive(0.0) is None
    notify = clients[0].notify
    assert notify is not None
    notify(None, bytearray(b"one"))
    clock.burn_ns(1)
    notify(None, bytearray(b"two"))
    assert link.receive(0.0) == (KNOWN, b"one", 7)
    assert link.receive(1.0) == (KNOWN, b"two", 8)
    assert link.read(KNOWN, 1.0) == b"\x25"
    link.close()
    link.close()
    assert not clients[0].connected
    with pytest.raises(Closed):
        link.receive(0.0)


def test_what_can_go_wrong(clients: list[Client]):
    with pytest.raises(DeviceNotFound, match="no peripheral 'OTHER'"):
        BleakGatt("OTHER", VirtualClock(), timeout_s=0.1)
    link = BleakGatt("D9:D2:38:9A:7E:21", VirtualClock())
    try:
        assert clients[0].device == "D9:D2:38:9A:7E:21"
        with pytest.raises(DeviceNotFound, match="no characteristic"):
            link.read("00002a19-0000-1000-8000-00805f9b34fb", 1.0)
        clients[0].refuse = True
        with pytest.raises(BusError, match="reading failed: refused"):
            link.read(KNOWN, 1.0)
        clients[0].lose(None)
        with pytest.raises(Disconnected):
            link.receive(0.0)
    finally:
        link.close()


def test_full_queue_is_counted(clients: list[Client]):
    link = BleakGatt(NAME, VirtualClock())
    link.subscribe(KNOWN, 1.0)
    notify = clients[0].notify
    assert notify is not None
    for _ in range(1030):
        notify(None, bytearray(b"x"))
    assert link.dropped == 6
    link.close()


def test_without_the_package(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setitem(sys.modules, "bleak", None)
    with pytest.raises(HalError, match=r"uv pip install -e '.\[ble\]'"):
        BleakGatt(NAME, VirtualClock())
