"""A line that takes no more bytes below a compiled run in real time: the outputs become neutral once it moves again.

Where they are is the emulated controller's truth; no test asserts on time of the host.
"""

from __future__ import annotations

import contextlib
import os
import select
import signal
import socket
import threading
import time
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from firmware_py.app import run_in_process
from firmware_py.run.findings import CauseClass
from firmware_py.run_request import RunRequest
from hal.contracts import Clock
from hal.errors import Disconnected, HalTimeout
from hal.types import PortInfo
from tests.conftest import with_keys
from tools.research.faults.points import POINTS, write_bench

pytestmark = [pytest.mark.realtime, pytest.mark.timeout(240)]
BENCHES = Path(__file__).parents[2] / "benches"
NEUTRAL_V = 50.0
CLOSE_V = 0.02
AWAY_V = 0.5
QUEUE_BYTES = 4096
JAM_S = 1.0
STACKS_NS = 5_000_000
"""Time of the emulated stacks to follow a command."""
LIMIT_S = 60.0
"""The run is longer than any of this takes: a latched state or the operator ends it."""


class AdapterPort:
    """A serial adapter with a short queue in front of ``port``. ``jam`` lets it take nothing out of the queue."""

    def __init__(self, port: Any) -> None:
        self._port = port
        self._near, self._far = socket.socketpair()
        for end in (self._near, self._far):
            end.setblocking(False)
        self._near.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, QUEUE_BYTES)
        self._is_jammed = self._is_closed = False
        self._carrier = threading.Thread(target=self._carry, daemon=True)
        self._carrier.start()

    def jam(self) -> None:
        self._is_jammed = True

    def is_full(self) -> bool:
        return not select.select((), (self._near,), (), 0.0)[1]

    def free(self) -> None:
        self._is_jammed = False

    def _carry(self) -> None:
        room = memoryview(bytearray(4096))
        with contextlib.suppress(Disconnected, OSError, ValueError):
            while not self._is_closed:
                from_firmware = [] if self._is_jammed else [self._far]
                ready = select.select([self._port, *from_firmware], (), (), 0.001)[0]
                if self._far in ready:
                    self._port.write(self._far.recv(4096), 1.0)
                if self._port in ready:
                    self._far.send(room[: self._port.read_into(room, 0.0)])

    def fileno(self) -> int:
        return self._near.fileno()

    def read_into(self, buf: memoryview, timeout_s: float) -> int:
        return os.readv(self.fileno(), [buf]) if select.select([self._near], (), (), timeout_s)[0] else 0

    def write(self, data: bytes, timeout_s: float) -> None:
        done = 0
        with contextlib.suppress(BlockingIOError):
            done = self._near.send(data)
        if done < len(data):
            raise HalTimeout(f"only {done} of {len(data)} bytes written", device="adapter", partial=done)

    def drain_input(self) -> int:
        n, room = 0, memoryview(bytearray(4096))
        while got := self.read_into(room, 0.0):
            n += got
        return n

    def info(self) -> PortInfo:
        return self._port.info()

    def close(self) -> None:
        self._is_closed = True
        self._carrier.join()
        self._port.close()
        self._near.close()
        self._far.close()


def test_a_line_that_jams_below_the_compiled_loop_is_found_and_neutral_as_soon_as_it_moves(tmp_path: Path):
    """An E-727 holds its outputs while it hears nothing: nothing can be promised before there is room. What the queue
    holds then still moves the outputs, and neutral is not said to be reached before all of that is done."""
    file = write_bench(BENCHES / "micron-e727.toml", POINTS[1], tmp_path)
    file.write_text(with_keys(file.read_text(), "firmware.safety", "holds_per_minute = 60\n"))
    adapters: list[AdapterPort] = []
    blows: list[threading.Thread] = []
    is_over = threading.Event()
    free_ns: list[int] = []

    def wrap(bus: str, port: Any, _clock: Clock) -> Any:
        if bus != "e7270":
            return port
        adapters.append(AdapterPort(port))
        return adapters[-1]

    def jam() -> None:
        (adapter,) = adapters
        adapter.jam()
        while not (adapter.is_full() or is_over.wait(0.001)):
            pass
        is_over.wait(JAM_S)
        free_ns.append(time.monotonic_ns())
        adapter.free()

    def strike_once(status: Mapping[str, Any]) -> None:
        moves = any(abs(volts - NEUTRAL_V) > AWAY_V for volts in status.get("command_V", ()))
        if not blows and moves and status["state"] == "running":
            blows.append(threading.Thread(target=jam))
            blows[0].start()
        if free_ns and status["state"] == "running" and status.get("holds"):
            signal.raise_signal(signal.SIGINT)  # it has resumed: enough

    request = RunRequest(file, LIMIT_S, pace="realtime", stale_ms=300.0, compiled=True)
    outcome, truth = run_in_process(request, strike_once, tmp_path, wrap=wrap)
    is_over.set()
    for blow in blows:
        blow.join()
    assert truth is not None
    safe, holds = outcome["safe_state"], outcome["holds"]
    if not blows or (holds and holds[0]["class"] == CauseClass.HOST):
        pytest.skip(f"this host stood still: {safe['reason']} {holds}")
    assert outcome["loop"]["kind"] == "compiled"
    assert outcome["loop"]["ticks"] > 0
    assert holds[0]["cause"].startswith("piezo: "), holds
    assert safe["reached"], safe["reason"]
    t_ns, away_V = truth["t_ns"], np.abs(truth["amplifier_V"] - NEUTRAL_V).max(axis=1)
    assert away_V[t_ns < free_ns[0]].max() > AWAY_V
    if not holds[0]["resumed"]:
        settled_ns = safe["reached_ns"] + STACKS_NS
        assert settled_ns > free_ns[0], "nobody could know of neutral before"
        assert away_V[t_ns > settled_ns].max(initial=0.0) < CLOSE_V
    assert away_V[-1] < CLOSE_V
