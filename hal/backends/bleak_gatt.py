"""Implements ``GattClient`` over the asyncio client of the ``bleak`` package (Bluetooth Low Energy, extra ``ble``).

Its event loop runs in a thread of its own; every call into it has a limit. Never yet run against a radio: the
tests put a stand-in in the place of ``bleak``.
"""

from __future__ import annotations

import asyncio
import importlib
import queue
import threading
from collections.abc import Callable, Coroutine
from concurrent.futures import TimeoutError as FutureTimeout
from typing import Any, TypeVar

from hal.contracts import Clock
from hal.errors import BusError, Closed, DeviceNotFound, Disconnected, HalTimeout
from hal.types import PortInfo

QUEUE_LIMIT = 1024
T = TypeVar("T")


def load() -> Any:
    """Return the package. ``DeviceNotFound`` says how to install it."""
    try:
        return importlib.import_module("bleak")
    except ImportError as error:
        raise DeviceNotFound(
            "the package 'bleak' is not installed: uv pip install -e '.[ble]' in the project's folder"
        ) from error


class BleakGatt:
    """Scans for a peripheral by its advertised name or its address, connects, and serves ``GattClient``.

    ``dropped`` counts notifications that nobody fetched in time.
    """

    def __init__(self, peripheral: str, clock: Clock, *, timeout_s: float = 10.0) -> None:
        bleak = load()
        self.dropped = 0
        self._failures = (bleak.exc.BleakError, OSError, EOFError)
        self._peripheral = peripheral
        self._clock = clock
        self._lost = threading.Event()
        self._queue: queue.Queue[tuple[str, bytes, int]] = queue.Queue(QUEUE_LIMIT)
        self._loop = asyncio.new_event_loop()
        self._thread = threading.Thread(target=self._loop.run_forever, name="bleak", daemon=True)
        self._thread.start()
        self._client: Any = None
        try:
            self._client = self._call(self._connect(bleak, timeout_s), 2.0 * timeout_s, "connecting")
        except BaseException:
            self._stop_loop()
            raise

    def subscribe(self, characteristic: str, timeout_s: float) -> None:
        self._require_known(characteristic)
        self._call(self._open().start_notify(characteristic, self._taker(characteristic)), timeout_s, "subscribing")

    def receive(self, timeout_s: float) -> tuple[str, bytes, int] | None:
        self._open()
        try:
            return self._queue.get(block=timeout_s > 0, timeout=timeout_s or None)
        except queue.Empty:
            if self._lost.is_set():
                raise Disconnected("the Bluetooth link is gone", device=self._peripheral) from None
            return None

    def read(self, characteristic: str, timeout_s: float) -> bytes:
        self._require_known(characteristic)
        return bytes(self._call(self._open().read_gatt_char(characteristic), timeout_s, "reading"))

    def info(self) -> PortInfo:
        return PortInfo(f"ble://{self._peripheral}", "bleak", emulated=False)

    def close(self) -> None:
        client, self._client = self._client, None
        if client is None:
            return
        try:
            self._call(client.disconnect(), 5.0, "disconnecting")
        finally:
            self._stop_loop()

    async def _connect(self, bleak: Any, timeout_s: float) -> Any:
        scanner = bleak.BleakScanner
        find = scanner.find_device_by_address if self._peripheral.count(":") == 5 else scanner.find_device_by_name
        device = await find(self._peripheral, timeout=timeout_s)
        if device is None:
            raise DeviceNotFound(
                f"no peripheral {self._peripheral!r} advertises within {timeout_s} s; is it switched on, in reach "
                "and not connected to another central?"
            )
        client = bleak.BleakClient(device, disconnected_callback=self._disconnected)
        await client.connect()
        return client

    def _disconnected(self, _: Any) -> None:
        self._lost.set()

    def _taker(self, characteristic: str) -> Callable[[Any, bytearray], None]:
        def take(_: Any, value: bytearray) -> None:
            item = (characteristic, bytes(value), self._clock.now_ns())
            try:
                self._queue.put_nowait(item)
            except queue.Full:
                self.dropped += 1

        return take

    def _require_known(self, characteristic: str) -> None:
        if self._open().services.get_characteristic(characteristic) is None:
            raise DeviceNotFound(f"no characteristic {characteristic}: another device?", device=self._peripheral)

    def _open(self) -> Any:
        if self._client is None:
            raise Closed("used after close()", device=self._peripheral)
        return self._client

    def _call(self, work: Coroutine[Any, Any, T], timeout_s: float, what: str) -> T:
        future = asyncio.run_coroutine_threadsafe(work, self._loop)
        try:
            return future.result(timeout_s)
        except FutureTimeout as error:
            future.cancel()
            raise HalTimeout(f"{what} took longer than {timeout_s} s", device=self._peripheral) from error
        except self._failures as error:
            raise BusError(f"{what} failed: {error}", device=self._peripheral) from error

    def _stop_loop(self) -> None:
        self._loop.call_soon_threadsafe(self._loop.stop)
        self._thread.join(5.0)
        self._loop.close()
