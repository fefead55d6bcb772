"""The compiled loop over a socket pair: byte for byte the commands that Python makes of the same scans."""

from __future__ import annotations

import os
import socket
import threading
from collections.abc import Iterator

import numpy as np
import pytest

from benchmarks import step_input, wire_loop
from firmware_py.frame import COMMAND, COUNTS, MAGNETOMETER_FRESH, STATUS, TICK, TIME

N = 200
pytestmark = pytest.mark.slow  # the loop holds the whole step and takes a minute to compile


class Loop:
    """``serve_port`` in a thread; ``ended`` is what it returned, ``far`` the other end of its port."""

    def __init__(self, ticks: int) -> None:
        self.far, ours = socket.socketpair()
        self.far.settimeout(20.0)
        self.ended = -1
        self._fd = ours.detach()
        os.set_blocking(self._fd, False)
        stages = step_input.settled(0)[0]
        wire_loop.serve_port(stages, self._fd, 0)  # compiled or loaded before anybody waits
        self._thread = threading.Thread(target=self._run, args=(stages, ticks))
        self._thread.start()

    def _run(self, stages: object, ticks: int) -> None:
        self.ended = wire_loop.serve_port(stages, self._fd, ticks)  # type: ignore[arg-type]

    def ask(self, *pieces: bytes) -> bytes:
        """Send, and return the command that follows."""
        for piece in pieces:
            self.far.sendall(piece)
        got = b""
        while not got.endswith(b"\n"):
            got += self.far.recv(256)
        return got

    def has_ended(self, within_s: float) -> bool:
        self._thread.join(within_s)
        return not self._thread.is_alive()

    def close(self) -> int:
        self.far.close()
        self._thread.join()
        if self._fd >= 0:
            os.close(self._fd)
            self._fd = -1
        return self.ended


@pytest.fixture
def loop() -> Iterator[Loop]:
    made = Loop(N)
    yield made
    made.close()


def scans() -> np.ndarray:
    return step_input.settled(N)[1][:, COUNTS : COUNTS + 8].astype("<i2")


def commands(rows: np.ndarray) -> list[bytes]:
    """In Python, as the loop's tasks do it: a frame a tick, one call of the step, Python's own formatting."""
    stages = step_input.settled(0)[0]
    frame, told = stages.frame, list[bytes]()
    for k, row in enumerate(rows):
        frame[TIME], frame[TICK], frame[STATUS] = k * 1e-3, k, 0.0
        frame[MAGNETOMETER_FRESH] = float(k % wire_loop.FIELD_TICKS == 0)
        frame[COUNTS : COUNTS + 8] = row
        stages.command()
        stages.step()
        a, b, c = frame[COMMAND : COMMAND + 3]
        told.append(f"SVA 1 {a:.4f} 2 {b:.4f} 3 {c:.4f}\n".encode())
    return told


def test_the_commands_are_pythons_whatever_the_pieces(loop: Loop) -> None:
    rows, rng = scans(), np.random.default_rng(1)
    told = []
    for row in rows:
        data, cut = row.tobytes(), int(rng.integers(0, 17))
        told.append(loop.ask(data[:cut], data[cut:]))
    assert told == commands(rows)
    assert len(set(told)) > N // 2, "the commands move"
    assert loop.close() == wire_loop.ENDED


def test_an_impossible_scan_gets_no_command(loop: Loop) -> None:
    rows = scans()
    rows[20, 3] = 32767  # at the end of its range
    for row in rows[:20]:
        loop.ask(row.tobytes())
    loop.far.sendall(rows[20].tobytes())
    assert loop.close() == wire_loop.IMPLAUSIBLE


def test_after_lost_bytes_nothing_is_commanded(loop: Loop) -> None:
    rows = scans()
    loop.ask(rows[0].tobytes())
    loop.far.sendall(rows[1].tobytes()[:-1])
    for row in rows[2:]:
        loop.far.sendall(row.tobytes())
        if loop.has_ended(0.005):
            break
    loop.far.setblocking(False)
    with pytest.raises(BlockingIOError):
        loop.far.recv(1)
    assert loop.close() == wire_loop.BAD_STREAM
