"""Base of register-mapped I2C sensors: pointer, auto-increment, one instant per byte, sample clocks, outputs.

Source: UM10204 (I2C-bus specification) sec. 3.1.10: a write segment starts with the register number, a read segment
continues from there. A byte that is read was fetched when its own nine clocks began, so a burst takes time and may
straddle an update; a device that guards against that does so itself.

Model limits
- Bytes are written at the end of their segment, all at one instant.
- ``frozen`` (fault hook) stops sampling and ignores writes; registers can still be read.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Iterator, Mapping

HISTORY = 64


class RegisterFace:
    """Wire face over 256 one-byte registers. ``masks`` says which bits of which registers the host may write."""

    def __init__(self, reset_values: Mapping[int, int], masks: Mapping[int, int]) -> None:
        self.nack_address = False
        self.nack_data = False
        self.frozen = False
        self.registers = bytearray(256)
        self._reset_values, self._masks = reset_values, masks
        self._pointer = 0
        self._byte_ns = 0.0
        self.load_reset_values()

    def load_reset_values(self) -> None:
        self.registers[:] = bytes(256)
        for register, value in self._reset_values.items():
            self.registers[register] = value

    # ------------------------------------------------------------------ for the device to override

    def read_register(self, register: int, t_ns: int) -> int:
        """The byte that is fetched at ``t_ns``; with its side effects."""
        return self.registers[register]

    def write_register(self, register: int, value: int, t_ns: int) -> None:
        """Store what may be stored."""
        mask = self._masks.get(register, 0)
        self.registers[register] = self.registers[register] & ~mask & 0xFF | value & mask

    def next_register(self, register: int) -> int:
        """Return the register that auto-increment selects next."""
        return register + 1 & 0xFF

    def advance_to(self, t_ns: int) -> None: ...

    def next_event_ns(self) -> int | None:
        return None

    # ------------------------------------------------------------------ wire face

    def acknowledges(self) -> bool:
        return not self.nack_address

    def start(self, t_ns: int, byte_ns: float) -> None:
        """A transfer to this address begins; its bytes take ``byte_ns`` each."""
        self._byte_ns = byte_ns

    def stop(self) -> None:
        """The bus is idle again."""
        self._byte_ns = 0.0

    def write(self, data: bytes, t_ns: int) -> int:
        if self.nack_data:
            return 0
        self.advance_to(t_ns)
        if data:
            self._pointer = data[0]
        for value in data[1:]:
            if not self.frozen:
                self.write_register(self._pointer, value, t_ns)
            self._pointer = self.next_register(self._pointer)
        return len(data)

    def read(self, n: int, t_ns: int) -> bytes:
        self.advance_to(t_ns)
        out = bytearray()
        for left in range(n, 0, -1):
            out.append(self.read_register(self._pointer, t_ns - int(left * self._byte_ns)))
            self._pointer = self.next_register(self._pointer)
        return bytes(out)

    def general_call(self, data: bytes, t_ns: int) -> bool:
        """Refuse address 0: none of these parts answers it."""
        return False


class SampleClock:
    """Counts the instants of an oscillator without accumulated rounding. ``due_ns`` is the next one, ``None`` while it
    stands."""

    def __init__(self) -> None:
        self.due_ns: int | None = None
        self.ticks = 0
        self._period_ns = 0.0
        self._begin_ns = 0

    def run(self, t_ns: int, period_ns: float, first_ns: int | None = None) -> None:
        """Start anew: the first tick comes ``first_ns`` (default one period) after ``t_ns``."""
        self._period_ns, self.ticks = period_ns, 0
        self._begin_ns = t_ns + (round(period_ns) if first_ns is None else first_ns)
        self.due_ns = self._begin_ns

    def halt(self) -> None:
        self.due_ns = None

    def skip_past(self, t_ns: int) -> None:
        """Leave out every tick up to ``t_ns``; those after it come when they would have come anyway."""
        if self.due_ns is not None and self.due_ns <= t_ns:
            self.ticks = max(self.ticks, int((t_ns - self._begin_ns) / self._period_ns) - 1)
            while self.due_ns <= t_ns:
                self.tick()

    def tick(self) -> None:
        self.ticks += 1
        self.due_ns = self._begin_ns + round(self.ticks * self._period_ns)

    def ticks_until(self, t_ns: int, *, frozen: bool) -> Iterator[int]:
        """Yield the instant of each tick up to ``t_ns``, after ``tick``. Those of a ``frozen`` part are left out."""
        if frozen:
            self.skip_past(t_ns)
        while (due_ns := self.due_ns) is not None and due_ns <= t_ns:
            self.tick()
            yield due_ns


class Outputs:
    """The last results with their times, so that each byte of a burst finds the result of its own instant."""

    def __init__(self, empty: bytes) -> None:
        self._empty = empty
        self._past: deque[tuple[int, bytes]] = deque(maxlen=HISTORY)

    def clear(self) -> None:
        self._past.clear()

    def push(self, t_ns: int, block: bytes) -> None:
        self._past.append((t_ns, block))

    def at(self, t_ns: int) -> tuple[int, bytes]:
        """Time (-1: none yet) and bytes of the newest result not later than ``t_ns``."""
        for entry in reversed(self._past):
            if entry[0] <= t_ns:
                return entry
        return -1, self._empty


def signed_limited(value: float, bits: int = 16) -> int:
    """``value`` rounded and limited to a signed number of ``bits``."""
    limit = 1 << bits - 1
    return max(-limit, min(limit - 1, round(value)))


def signed_byte(value: int) -> int:
    """Return the integer of a two's complement byte."""
    return value - 0x100 if value & 0x80 else value
