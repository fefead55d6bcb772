"""Shares one CAN bus between several drivers: each gets a view that receives only its own frames.

The driver that receives sorts arriving frames into all views, so no thread is needed.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Iterable

from hal.contracts import CanBus
from hal.errors import BenchError
from hal.types import CanFrame, CanStats, PortInfo

QUEUE_FRAMES = 1024


class SharedCan:
    """Owns the bus. Views receive base frames; ``unclaimed`` counts frames that no view receives."""

    def __init__(self, bus: CanBus) -> None:
        self.unclaimed = 0
        self._bus = bus
        self._views: dict[int, CanView] = {}

    def view(self, can_ids: Iterable[int]) -> CanView:
        """Return a CanBus that receives exactly these ids. Raises ``BenchError`` when one is already claimed."""
        wanted = frozenset(can_ids)
        for can_id in wanted:
            if can_id in self._views:
                raise BenchError(f"CAN id 0x{can_id:X} is already received by another driver")
        view = CanView(self, self._bus)
        self._views.update(dict.fromkeys(wanted, view))
        return view

    def pump(self, timeout_s: float) -> bool:
        """Receive one frame and hand it to its view. Return False when none came within ``timeout_s``."""
        frame = self._bus.recv(timeout_s)
        if frame is None:
            return False
        view = None if frame.extended else self._views.get(frame.can_id)
        if view is None:
            self.unclaimed += 1
        else:
            view.accept(frame)
        return True

    def close(self) -> None:
        self._bus.close()


class CanView:
    """Implements the ``CanBus`` contract for one driver. ``close`` does nothing: the bus belongs to its owner."""

    def __init__(self, owner: SharedCan, bus: CanBus) -> None:
        self._owner = owner
        self._bus = bus
        self._queue: deque[CanFrame] = deque()
        self._rx = 0
        self._tx = 0
        self._dropped = 0

    @property
    def below(self) -> CanBus:
        """The bus that is shared."""
        return self._bus

    def accept(self, frame: CanFrame) -> None:
        """Queue ``frame``; the owner calls this. A full queue drops its oldest frame and counts it."""
        if len(self._queue) == QUEUE_FRAMES:
            self._queue.popleft()
            self._dropped += 1
        self._queue.append(frame)

    def send(self, frame: CanFrame, timeout_s: float) -> None:
        self._bus.send(frame, timeout_s)
        self._tx += 1

    def recv(self, timeout_s: float) -> CanFrame | None:
        """Wait for a frame of this view. Each frame of another view restarts the wait of ``timeout_s``."""
        while not self._queue and self._owner.pump(timeout_s):
            pass
        if not self._queue:
            return None
        self._rx += 1
        return self._queue.popleft()

    def stats(self) -> CanStats:
        below = self._bus.stats()
        return CanStats(self._rx, self._tx, self._dropped + below.dropped, below.error_frames)

    def info(self) -> PortInfo:
        return self._bus.info()

    def close(self) -> None:
        pass
