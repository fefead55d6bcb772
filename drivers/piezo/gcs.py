"""Speaks GCS 2.0 on a serial line: commands, queries and the deferred error query. It knows no axis and no volt.

Source: PI manual E727T0005 (GCS syntax; command "ERR?"), reply ends from PI's own client: every line but the last
ends with SP LF, the last with LF.
"""

from __future__ import annotations

import contextlib
import math
from array import array
from typing import Any, NamedTuple

import numpy as np

from hal.contracts import Clock, SerialPort
from hal.errors import HalError, HalTimeout, ProtocolError

ERRORS = {
    1: "parameter syntax error",
    2: "unknown command",
    5: "move without reference, or servo off",
    7: "position out of limits",
    10: "stopped by command",
    15: "invalid axis",
    17: "parameter out of range",
    24: "wrong number of parameters",
    301: "send buffer overflow",
    302: "voltage out of limits",
    303: "open-loop motion with the servo on",
    304: "receive buffer overflow",
    307: "receive timeout",
    333: "hardware error",
}
ERROR_QUERY = b"ERR?\n"
LONGEST_REPLY = 4096  # a controller that never ends a line is not one
NOTHING, ACCEPTED, COMPLAINT = range(3)
"""Verdicts of ``take_answer``: no whole answer yet; "0", no error; an answer that the caller has to read."""
LINE_FEED, ZERO = 10, 48
NEVER = -1


class LinkMemory(NamedTuple):
    """Holds what a link knows, for Python and for a compiled loop.

    ``asked_ns`` (1,): when ``ERR?`` was sent, NEVER when no answer is awaited; ``sizes``: bytes used of ``line``, the
    answer so far, and of ``unsent``, which the port did not take at once."""

    asked_ns: Any
    sizes: Any
    line: Any
    unsent: Any

    def view(self) -> LinkMemory:
        """Return numpy arrays over the same memory, for compiled code."""
        asked_ns, sizes, line, unsent = self
        return LinkMemory(
            np.frombuffer(asked_ns, np.int64), np.frombuffer(sizes, np.int64), np.frombuffer(line, np.uint8),
            np.frombuffer(unsent, np.uint8),
        )  # fmt: skip


LINE, UNSENT = 0, 1
"""Places in ``LinkMemory.sizes``."""
UNSENT_BYTES = 256


def new_memory() -> LinkMemory:
    return LinkMemory(array("q", [NEVER]), array("q", [0, 0]), bytearray(LONGEST_REPLY), bytearray(UNSENT_BYTES))


def take_answer(memory: LinkMemory, data: Any, n: int) -> int:
    """Append ``data[:n]`` to the answer to ``ERR?``. Return the verdict; the answer "0" is done with then, any other
    stays in ``line``. An answer longer than ``line`` is a complaint."""
    sizes, line = memory.sizes, memory.line
    for i in range(n):
        if sizes[LINE] == len(line):
            return COMPLAINT
        line[sizes[LINE]] = data[i]
        sizes[LINE] += 1
    end = 0
    while end < sizes[LINE] and line[end] != LINE_FEED:
        end += 1
    if end == sizes[LINE]:
        return NOTHING
    if end != 1 or line[0] != ZERO:
        return COMPLAINT
    for i in range(end + 1, sizes[LINE]):
        line[i - end - 1] = line[i]
    sizes[LINE] -= end + 1
    memory.asked_ns[0] = NEVER
    return ACCEPTED


def keep_unsent(memory: LinkMemory, data: Any, begin: int, end: int) -> None:
    """Keep ``data[begin:end]``, which the port did not take."""
    for i in range(begin, end):
        memory.unsent[i - begin] = data[i]
    memory.sizes[UNSENT] = end - begin


def _is_whole(reply: bytes) -> bool:
    return reply.endswith(b"\n") and not reply.endswith(b" \n")


def _lines_of(reply: bytes) -> list[str]:
    return [line.strip() for line in reply.decode("latin-1").splitlines()]


class GcsLink:
    """Talks to one controller on one port. ``memory`` holds unsent bytes and the incomplete answer."""

    def __init__(self, port: SerialPort, clock: Clock, name: str, timeout_s: float = 0.5) -> None:
        self.name = name
        self._port = port
        self._clock = clock
        self.timeout_s = timeout_s
        self.memory = new_memory()
        self._stuck_ns = NEVER
        """Time (bench clock) at which a port that does not take all bytes last took some, ``NEVER`` if it takes all."""
        self._buf = memoryview(bytearray(256))

    # set-up: may wait, bounded

    def query(self, text: str) -> list[str]:
        """Send a query and wait for all lines of its reply. Raises ``HalTimeout``."""
        self._port.write(text.encode() + b"\n", self.timeout_s)
        limit_ns = self._clock.now_ns() + round(self.timeout_s * 1e9)
        reply = b""
        while not _is_whole(reply):
            left_s = (limit_ns - self._clock.now_ns()) * 1e-9
            n = self._port.read_into(self._buf, left_s) if left_s > 0 else 0
            if n == 0 or len(reply) > LONGEST_REPLY:
                raise HalTimeout(
                    f"no answer to {text!r} within {self.timeout_s} s, got {reply!r}",
                    device=self.name,
                    partial=len(reply),
                )
            reply += bytes(self._buf[:n])
        return _lines_of(reply)

    def values(self, text: str, n: int) -> list[float]:
        """Return the first ``n`` values of an answer with ``1=value`` per line. Raises ``ProtocolError`` for anything
        else, fewer values included."""
        return self._values_in(self.query(text), text, n)

    def _values_in(self, lines: list[str], text: str, n: int) -> list[float]:
        try:
            values = [float(line.split("=", 1)[1]) for line in lines]
            if not all(math.isfinite(value) for value in values):
                raise ValueError("not finite")
            if len(values) < n:
                raise ValueError("too few")
            return values[:n]
        except (IndexError, ValueError):
            raise ProtocolError(f"answer to {text!r} was {lines!r}, not {n} finite values", device=self.name) from None

    def command(self, text: str) -> None:
        """Send a set command and ask for its error at once. Raises ``ProtocolError`` with the error's meaning."""
        self._port.write(text.encode() + b"\n", self.timeout_s)
        answer = self.query("ERR?")
        self._check(answer[-1], text)

    def clear_error(self) -> None:
        """Read and forget a latched error."""
        self.query("ERR?")

    # in the loop: never waits

    def send(self, data: bytes) -> bool:
        """Hand ``data`` to the port without waiting. Return False if an earlier command is still stuck; nothing of
        ``data`` was taken then. Raises ``HalTimeout`` when the port has taken nothing for ``timeout_s``."""
        if not self._is_free():
            return False
        keep_unsent(self.memory, data, 0, len(data))
        self._push()
        return True

    def ask_error(self) -> None:
        """Send ``ERR?`` unless one is under way; ``take_error`` reads the answer later."""
        if not self._awaits and self.send(ERROR_QUERY):
            self.memory.asked_ns[0] = self._clock.now_ns()

    def take_error(self) -> None:
        """Read what has come. Raises ``ProtocolError`` for a latched error, ``HalTimeout`` for a late answer and for a
        port that takes nothing for as long."""
        self._is_free()
        if not self._awaits:
            return
        n = self._port.read_into(self._buf, 0.0)
        if n or self.memory.sizes[LINE]:
            verdict = take_answer(self.memory, self._buf, n)
            if verdict == COMPLAINT:
                self._read_complaint()
            if verdict != NOTHING:
                return
        self._require_answer_in_time("ERR?")

    def ask(self, text: str) -> bool:
        """Send the query ``text`` for ``take_values``. False while an answer is under way or bytes are stuck. Raises
        what ``take_error`` and ``send`` do."""
        self.take_error()
        if self._awaits or not self.send(text.encode() + b"\n"):
            return False
        self.memory.asked_ns[0] = self._clock.now_ns()
        return True

    def take_values(self, text: str, n: int) -> list[float] | None:
        """Return the answer to ``ask``, see ``values``; ``None`` while it is under way. Raises ``HalTimeout`` where it
        is late."""
        memory = self.memory
        self._is_free()
        got = self._port.read_into(self._buf, 0.0)
        end = memory.sizes[LINE] + got
        if end > len(memory.line):
            raise ProtocolError(f"the answer to {text!r} does not end", device=self.name)
        memory.line[memory.sizes[LINE] : end] = self._buf[:got]
        memory.sizes[LINE] = end
        if not _is_whole(reply := bytes(memory.line[:end])):
            self._require_answer_in_time(text)
            return None
        memory.asked_ns[0], memory.sizes[LINE] = NEVER, 0
        return self._values_in(_lines_of(reply), text, n)

    def forget_answer(self) -> None:
        """Expect no answer any more, and discard what has come of it."""
        self.memory.asked_ns[0], self.memory.sizes[LINE] = NEVER, 0
        with contextlib.suppress(HalError):  # the next call says it
            self._port.drain_input()

    def _require_answer_in_time(self, text: str) -> None:
        if self._clock.now_ns() - self.memory.asked_ns[0] > self.timeout_s * 1e9:
            raise HalTimeout(f"no answer to {text!r} within {self.timeout_s} s: link lost?", device=self.name)

    def _read_complaint(self) -> None:
        memory = self.memory
        text = bytes(memory.line[: memory.sizes[LINE]])
        answer, _, rest = text.partition(b"\n")
        memory.line[: len(rest)] = rest
        memory.sizes[LINE] = len(rest)
        memory.asked_ns[0] = NEVER
        self._check(answer.decode("latin-1"), "an earlier command")

    def _is_free(self) -> bool:
        if not self._is_stuck or self._push():
            return True
        if self._clock.now_ns() - self._stuck_ns > self.timeout_s * 1e9:
            raise HalTimeout(
                f"the port has taken nothing for {self.timeout_s} s: check the cable and the controller",
                device=self.name,
            )
        return False

    @property
    def is_well(self) -> bool:
        """True while the port has taken everything at once."""
        return not self._is_stuck

    @property
    def _is_stuck(self) -> bool:
        return self.memory.sizes[UNSENT] > 0

    @property
    def _awaits(self) -> bool:
        return self.memory.asked_ns[0] != NEVER

    def settle(self) -> None:
        """Wait, bounded, for an answer under way, so that queries may be used again."""
        limit_ns = self._clock.now_ns() + round(self.timeout_s * 1e9)
        while (self._is_stuck or self._awaits) and self._clock.now_ns() < limit_ns:
            self.take_error()
            self._clock.sleep_until_ns(self._clock.now_ns() + 1_000_000)

    def close(self) -> None:
        self._port.close()

    def _push(self) -> bool:
        memory = self.memory
        data = bytes(memory.unsent[: memory.sizes[UNSENT]])
        try:
            self._port.write(data, 0.0)
        except HalTimeout as stuck:
            keep_unsent(memory, data, stuck.partial, len(data))
            if self._stuck_ns == NEVER or stuck.partial > 0:
                self._stuck_ns = self._clock.now_ns()
            return False
        memory.sizes[UNSENT] = 0
        self._stuck_ns = NEVER
        return True

    def _check(self, answer: str, text: str) -> None:
        try:
            code = int(answer)
        except ValueError:
            raise ProtocolError(f"answer to 'ERR?' was {answer!r}", device=self.name) from None
        if code:
            meaning = ERRORS.get(code, "see the manual's error list")
            raise ProtocolError(f"error {code} after {text!r}: {meaning}", device=self.name)
