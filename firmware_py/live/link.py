"""Holds the firmware's end of its link to the bench page: it shows frames and histograms, receives short orders, and
never waits."""

from __future__ import annotations

import json
import socket
from collections.abc import Callable, Generator, Iterator
from contextlib import suppress
from typing import Any, cast

from firmware_py.live.memory import HISTOGRAMS, LiveMemory
from firmware_py.scheduler.histogram import DurationHistogram

MAX_ORDERS = 4
"""Largest number of orders taken per call, which bounds what an eager sender costs a tick."""
_MAX_BYTES = 1024


class LiveLink:
    """Links the firmware to the bench page. ``memory_fd`` is mapped, ``control_fd`` is one end of a SOCK_SEQPACKET
    pair; both belong to this object."""

    def __init__(self, memory_fd: int, control_fd: int) -> None:
        self._memory = LiveMemory(memory_fd)
        self._control = socket.socket(fileno=control_fd)
        self._control.setblocking(False)
        self._hung_up = False
        self.publish, self.view = self._memory.push, self._memory.view

    def orders(self) -> Iterator[dict[str, Any]]:
        """Yield the orders that have arrived: JSON objects with a text under ``order``. Anything else is dropped."""
        for _ in range(MAX_ORDERS):
            if self._hung_up:
                return
            try:
                data = self._control.recv(_MAX_BYTES)
            except BlockingIOError:
                return
            except OSError:
                data = b""
            if not data:
                self._hung_up = True
                return
            with suppress(ValueError):
                order = cast("dict[str, Any]", json.loads(data))
                if isinstance(order, dict) and isinstance(order.get("order"), str):  # pyright: ignore[reportUnnecessaryIsInstance]
                    yield order

    def show(self, histograms: Callable[[], dict[str, DurationHistogram]]) -> Generator[bool, None, None]:
        """Run the background task that copies one histogram per step, in turn, in the order of ``histograms()``."""
        selected = list(histograms().values())[:HISTOGRAMS]
        while True:
            for index, histogram in enumerate(selected):
                self._memory.put_histogram(index, histogram)
                yield False

    def close(self) -> None:
        del self.publish, self.view
        self._memory.close()
        self._control.close()
