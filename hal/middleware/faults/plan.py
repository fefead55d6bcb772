"""Plans the faults of a port: which are injected and when. It counts those that were injected.

Faults are deterministic: the same seed, plan and traffic give the same faults. Loss and corruption apply to received
data; silence applies to both directions; a delay blocks the caller, as a slow link does.
"""

from __future__ import annotations

import math
import random
from dataclasses import dataclass, replace

from hal.contracts import CanBus, Clock, I2cBus, SerialPort
from hal.errors import Disconnected, HalTimeout
from hal.types import PortInfo


@dataclass(frozen=True, slots=True)
class FaultPlan:
    """Probabilities are per byte (serial), per transfer (I2C) or per frame (CAN).

    They hold from ``from_s`` on for ``for_s``; all times count from wrapping the port. ``truncation`` and
    ``reorder`` are per read (serial) or frame (CAN). ``write_corruption`` flips a bit of what is sent to an I2C
    device. ``bus_off_after_s`` (CAN) lets every send fail; ``babble_hz`` floods the bus with frames of the highest
    priority; ``error_frames_hz`` counts as a broken line does. ``reconnect_after_s`` ends a disconnection.
    ``full_after_s`` (serial, CAN): the queue of what is sent is full for ``full_for_s``, and takes nothing.
    """

    seed: int = 0
    loss: float = 0.0
    corruption: float = 0.0
    write_corruption: float = 0.0
    duplication: float = 0.0
    reorder: float = 0.0
    truncation: float = 0.0
    delay: float = 0.0
    delay_s: float = 0.0
    nack: float = 0.0
    from_s: float = 0.0
    for_s: float = math.inf
    silent_after_s: float | None = None
    silent_for_s: float = math.inf
    disconnect_after_s: float | None = None
    reconnect_after_s: float = math.inf
    bus_off_after_s: float | None = None
    babble_hz: float = 0.0
    error_frames_hz: float = 0.0
    full_after_s: float | None = None
    full_for_s: float = math.inf


@dataclass(slots=True)
class FaultCounts:
    """Holds the counts of the faults that were injected.

    ``silenced`` counts the bytes, transfers or frames that silence suppressed, ``refused`` the writes for which there
    was no room."""

    lost: int = 0
    corrupted: int = 0
    duplicated: int = 0
    reordered: int = 0
    truncated: int = 0
    delayed: int = 0
    nacked: int = 0
    silenced: int = 0
    refused: int = 0
    babbled: int = 0
    error_frames: int = 0
    disconnected: bool = False

    @property
    def any(self) -> bool:
        """Return True if any fault was injected."""
        return self != FaultCounts()


class Injector:
    """Decides for one port what happens next, and counts."""

    def __init__(self, plan: FaultPlan, clock: Clock, uri: str) -> None:
        self.counts = FaultCounts()
        self._clock = clock
        self._uri = uri
        self.begin(plan)

    def begin(self, plan: FaultPlan) -> None:
        self.plan = plan
        self.random = random.Random(plan.seed)
        self._start_ns = self._clock.now_ns()

    def now_s(self) -> float:
        return (self._clock.now_ns() - self._start_ns) * 1e-9

    def active(self) -> bool:
        return self.plan.from_s <= self.now_s() < self.plan.from_s + self.plan.for_s

    def happens(self, probability: float) -> bool:
        return probability > 0.0 and self.active() and self.random.random() < probability

    def check_connection(self) -> None:
        after_s = self.plan.disconnect_after_s
        if after_s is not None and after_s <= self.now_s() < after_s + self.plan.reconnect_after_s:
            self.counts.disconnected = True
            raise Disconnected("unplugged (injected fault)", device=self._uri)

    def silent(self) -> bool:
        after_s = self.plan.silent_after_s
        return after_s is not None and after_s <= self.now_s() < after_s + self.plan.silent_for_s

    def full(self) -> bool:
        """Return True while there is no room for what is sent."""
        after_s = self.plan.full_after_s
        return after_s is not None and after_s <= self.now_s() < after_s + self.plan.full_for_s

    def wait_for_room(self, timeout_s: float) -> None:
        """Wait as a write does that finds no room. Raises ``HalTimeout``: the fault outlives the wait."""
        if self.full():
            self._clock.sleep_until_ns(self._clock.now_ns() + round(timeout_s * 1e9))
            self.counts.refused += 1
            raise HalTimeout(f"nothing sent in {timeout_s} s: the queue is full (injected fault)", device=self._uri)

    def hold_up(self) -> None:
        if self.happens(self.plan.delay):
            self.counts.delayed += 1
            self._clock.sleep_until_ns(self._clock.now_ns() + round(self.plan.delay_s * 1e9))

    def flip_a_bit(self, data: memoryview, index: int) -> None:
        data[index] ^= 1 << self.random.randrange(8)
        self.counts.corrupted += 1

    def due(self, rate_hz: float, done: int) -> int:
        """Return the number of events at ``rate_hz`` that are due by now, less the ``done`` ones."""
        if rate_hz <= 0.0 or not self.active():
            return 0
        return max(0, int((self.now_s() - self.plan.from_s) * rate_hz) - done)


class FaultyPort:
    """Injects the faults of a plan into a port or bus. ``counts`` says which were injected."""

    def __init__(self, below: SerialPort | I2cBus | CanBus, clock: Clock, plan: FaultPlan) -> None:
        self._below = below
        self._clock = clock
        self._faults = Injector(plan, clock, below.info().uri)
        self.counts = self._faults.counts

    def arm(self, plan: FaultPlan) -> None:
        """Begin ``plan`` now, instead of the one before; the counts go on."""
        self._faults.begin(plan)

    def info(self) -> PortInfo:
        """Reports must say that a port is being sabotaged."""
        info = self._below.info()
        return replace(info, description=f"{info.description}, with injected faults")

    def close(self) -> None:
        self._below.close()
