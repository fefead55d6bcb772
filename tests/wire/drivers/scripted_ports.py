"""Ports that play a script from the manual: any other byte, or a leftover at the end, fails the test."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Sequence

from hal.clock import VirtualClock
from hal.errors import HalError
from hal.middleware.trace import read_transcript
from hal.types import CanFrame, CanStats, I2cOp, I2cWrite, PortInfo


class SilentSerial:
    """What a test's serial port does without being asked about it."""

    closed = False

    def drain_input(self) -> int:
        return 0

    def info(self) -> PortInfo:
        return PortInfo("scripted://", "script", emulated=True)

    def close(self) -> None:
        self.closed = True


class ScriptedSerial(SilentSerial):
    """Script entries: ``("w", b"...")`` expected writes, ``("r", b"...")`` one read, ``("wait",)`` a timeout,
    ``("at", t_ns)`` bench time of what follows, ``("raise", error)`` the next read fails."""

    def __init__(self, clock: VirtualClock, script: Sequence[tuple[object, ...]]) -> None:
        self.clock = clock
        self.script = deque(script)

    def write(self, data: bytes, timeout_s: float) -> None:
        assert 0.0 <= timeout_s < 60.0, "every wait has a limit"
        self._times()
        assert self.script, f"unexpected write {data!r}: the script is over"
        kind, *rest = self.script.popleft()
        assert kind == "w", f"wrote {data!r}, script wants {kind} {rest}"
        assert data == rest[0], f"wrote {data!r}, manual says {rest[0]!r}"

    def read_into(self, buf: memoryview, timeout_s: float) -> int:
        assert timeout_s >= 0.0
        self._times()
        if not self.script or self.script[0][0] == "w":
            self.clock.burn_ns(round(timeout_s * 1e9))
            return 0
        kind, *rest = self.script.popleft()
        if kind == "raise":
            error = rest[0]
            assert isinstance(error, HalError)
            raise error
        if kind == "wait":
            self.clock.burn_ns(round(timeout_s * 1e9))
            return 0
        data = rest[0]
        assert isinstance(data, bytes)
        n = min(len(buf), len(data))
        buf[:n] = data[:n]
        if n < len(data):
            self.script.appendleft(("r", data[n:]))
        return n

    def _times(self) -> None:
        while self.script and self.script[0][0] == "at":
            t_ns = self.script.popleft()[1]
            assert isinstance(t_ns, int)
            self.clock.advance_to(t_ns)

    def done(self) -> None:
        assert not self.script, f"left over: {list(self.script)}"


class ScriptedI2c:
    """Script entries: ``(address, [("w", bytes) or ("r", bytes the device gives)])`` or ``(address, error)``."""

    def __init__(self, script: Sequence[tuple[int, object]]) -> None:
        self.script = deque(script)

    def transfer(self, address: int, ops: Sequence[I2cOp]) -> bytes:
        assert self.script, f"unexpected transfer to 0x{address:02X}: {list(ops)}"
        wanted_address, wanted = self.script.popleft()
        assert address == wanted_address
        if isinstance(wanted, HalError):
            raise wanted
        assert isinstance(wanted, list)
        shape = [("w", op.data) if isinstance(op, I2cWrite) else ("r", op.n) for op in ops]
        expected = [(k, d if k == "w" else len(d)) for k, d in wanted]
        assert shape == expected
        return b"".join(d for k, d in wanted if k == "r")

    def info(self) -> PortInfo:
        return PortInfo("scripted://", "script", emulated=True)

    def close(self) -> None:
        raise AssertionError("a driver must not close the bus it shares")

    def done(self) -> None:
        assert not self.script, f"left over: {list(self.script)}"


class ScriptedCan:
    """A CAN bus whose other side is a test: ``sent`` holds what the driver sent, ``arrive`` queues a frame."""

    def __init__(self, clock: VirtualClock) -> None:
        self.clock = clock
        self.sent: list[tuple[int, str]] = []
        self.queue: deque[CanFrame] = deque()
        self.on_send: list[Callable[[CanFrame], None]] = []

    def arrive(self, can_id: int, data: str) -> None:
        self.queue.append(CanFrame(can_id, bytes.fromhex(data), t_ns=self.clock.now_ns()))

    def send(self, frame: CanFrame, timeout_s: float) -> None:
        assert timeout_s == 0.0, "a driver of the loop does not wait for the bus"
        self.sent.append((frame.can_id, frame.data.hex()))
        for react in self.on_send:
            react(frame)

    def recv(self, timeout_s: float) -> CanFrame | None:
        if not self.queue:
            self.clock.burn_ns(round(timeout_s * 1e9))
        return self.queue.popleft() if self.queue else None

    def stats(self) -> CanStats:
        return CanStats()

    def info(self) -> PortInfo:
        return PortInfo("scripted://", "script", emulated=True)

    def close(self) -> None:
        raise AssertionError("a driver must not close the bus it shares")


def serial_script(transcript: str) -> list[tuple[object, ...]]:
    """A golden transcript of ``hal.middleware.trace`` as a script for ``ScriptedSerial``."""
    return [(e.verb, bytes.fromhex(e.words[0])) for e in read_transcript(transcript.splitlines())]
