"""GCS 2.0 on a serial line: commands, queries and the deferred error query. Knows no axis and no volt.

Source: PI manual E727T0005 (GCS syntax; command "ERR?"), reply ends from PI's own client: every line but the last
ends with SP LF, the last with LF.
"""

from __future__ import annotations

import math

from hal.contracts import Clock, SerialPort
from hal.errors import HalTimeout, ProtocolError

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
LONGEST_REPLY = 4096  # a controller that never ends a line is not one


class GcsLink:
    """One controller on one port. ``unsent`` holds what the port did not take at once, in order."""

    def __init__(self, port: SerialPort, clock: Clock, name: str, timeout_s: float = 0.5) -> None:
        self.name = name
        self._port = port
        self._clock = clock
        self._timeout_s = timeout_s
        self._unsent = b""
        self._line = bytearray()
        self._buf = memoryview(bytearray(256))
        self._asked_ns: int | None = None

    # set-up: may wait, bounded

    def query(self, text: str) -> list[str]:
        """Send a query and wait for all lines of its reply. Raises ``HalTimeout``."""
        self._port.write(text.encode() + b"\n", self._timeout_s)
        limit_ns = self._clock.now_ns() + round(self._timeout_s * 1e9)
        reply = b""
        while not reply.endswith(b"\n") or reply.endswith(b" \n"):
            left_s = (limit_ns - self._clock.now_ns()) * 1e-9
            n = self._port.read_into(self._buf, left_s) if left_s > 0 else 0
            if n == 0 or len(reply) > LONGEST_REPLY:
                raise HalTimeout(
                    f"no answer to {text!r} within {self._timeout_s} s, got {reply!r}",
                    device=self.name,
                    partial=len(reply),
                )
            reply += bytes(self._buf[:n])
        return [line.strip() for line in reply.decode("latin-1").splitlines()]

    def values(self, text: str, n: int) -> list[float]:
        """The first ``n`` values of an answer with ``1=value`` per line. Raises ``ProtocolError`` for anything else,
        fewer values included."""
        lines = self.query(text)
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
        self._port.write(text.encode() + b"\n", self._timeout_s)
        answer = self.query("ERR?")
        self._check(answer[-1], text)

    def clear_error(self) -> None:
        """Read and forget a latched error."""
        self.query("ERR?")

    # in the loop: never waits

    def send(self, data: bytes) -> bool:
        """Hand ``data`` to the port without waiting. False when an earlier command is still stuck: then nothing
        of ``data`` was taken."""
        if self._unsent and not self._push():
            return False
        self._unsent = data
        self._push()
        return True

    def ask_error(self) -> None:
        """Send ``ERR?`` unless one is under way; ``take_error`` finds the answer later."""
        if self._asked_ns is None and self.send(b"ERR?\n"):
            self._asked_ns = self._clock.now_ns()

    def take_error(self) -> None:
        """Read what has come. Raises ``ProtocolError`` for a latched error, ``HalTimeout`` for a late answer."""
        if self._unsent:
            self._push()
        if self._asked_ns is None:
            return
        n = self._port.read_into(self._buf, 0.0)
        if n:
            self._line += self._buf[:n]
            end = self._line.find(b"\n")
            if end >= 0:
                answer = self._line[:end].decode("latin-1")
                del self._line[: end + 1]
                self._asked_ns = None
                self._check(answer, "an earlier command")
                return
        if self._clock.now_ns() - self._asked_ns > self._timeout_s * 1e9:
            raise HalTimeout(f"no answer to 'ERR?' within {self._timeout_s} s: link lost?", device=self.name)

    def settle(self) -> None:
        """Wait, bounded, for an answer under way, so that queries may be used again."""
        limit_ns = self._clock.now_ns() + round(self._timeout_s * 1e9)
        while (self._unsent or self._asked_ns is not None) and self._clock.now_ns() < limit_ns:
            self.take_error()
            self._clock.sleep_until_ns(self._clock.now_ns() + 1_000_000)

    def close(self) -> None:
        self._port.close()

    def _push(self) -> bool:
        try:
            self._port.write(self._unsent, 0.0)
        except HalTimeout as stuck:
            self._unsent = self._unsent[stuck.partial :]
            return False
        self._unsent = b""
        return True

    def _check(self, answer: str, text: str) -> None:
        try:
            code = int(answer)
        except ValueError:
            raise ProtocolError(f"answer to 'ERR?' was {answer!r}", device=self.name) from None
        if code:
            meaning = ERRORS.get(code, "see the manual's error list")
            raise ProtocolError(f"error {code} after {text!r}: {meaning}", device=self.name)
