"""Commands of compiled code to the emulated E-727 over a pty that nobody reads: it is handed over, and nothing waits.

Where the outputs are is the emulated controller's truth. An E-727 holds its outputs while it hears nothing.
"""

from __future__ import annotations

import contextlib
import os
import select
import time
from collections.abc import Iterator
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from drivers.piezo.e727 import E727
from drivers.piezo.e727_kernels import LINE_FEED
from drivers.piezo.e727_loop import SENT
from drivers.piezo.e727_words import ASK_ERROR_EVERY
from firmware_py.compiled import outputs
from firmware_py.compiled.sides import E727Side
from hal.backends.pyserial_port import PyserialPort
from hal.clock import MonotonicClock
from hal.compiled import thread_kernel
from hal.errors import HalTimeout
from sim_devices.devices import e727
from sim_devices.transports.pty_carrier import PtyCarrier

MS = 1_000_000
AWAY_V = [60.0, 40.0, 50.0]


@thread_kernel
def write(out: Any, fd: int, values_V: NDArray[np.float64], now_ns: int) -> tuple[int, int]:
    return outputs.write(out, fd, values_V, now_ns)


@thread_kernel
def step_ramp(out: Any, fd: int, now_ns: int) -> bool:
    return outputs.step_ramp(out, fd, now_ns)


@thread_kernel
def is_stuck(out: Any) -> bool:
    return outputs.is_stuck(out)


class Stand:
    """The emulated controller behind a pty, and the compiled side of its driver. The test moves their time."""

    def __init__(self) -> None:
        self.controller = e727.E727()
        self.carrier = PtyCarrier(self.controller)
        clock = MonotonicClock()
        self.driver = E727(PyserialPort(self.carrier.path, 115200), clock)
        self.driver.guard.armed = True
        self.side = E727Side(self.driver, clock)
        self.memory = self.side.memory(np.zeros(1, np.int64))
        self.t_ns = clock.now_ns()

    def write(self) -> int:
        self.t_ns += 10 * MS
        return write(self.memory, self.side.fileno(), np.array(AWAY_V), self.t_ns)[0]

    def step(self) -> bool:
        self.t_ns += MS
        return step_ramp(self.memory, self.side.fileno(), self.t_ns)

    def fill(self) -> None:
        """Write empty lines until the pty takes no more."""
        taken = 1
        while taken:
            taken = 0
            with contextlib.suppress(BlockingIOError):
                while True:
                    taken += os.write(self.side.fileno(), bytes((LINE_FEED,)))
            time.sleep(0.1)  # its worker may make room a little later

    def read_all(self) -> None:
        """Let the controller read its line, and pass the time that the bytes take there."""
        while select.select([self.carrier.fileno()], [], [], 0.05)[0]:  # a pty's worker moves bytes a little later
            self.carrier.receive(self.t_ns)
        self.t_ns += 5_000 * MS
        self.controller.advance_to(self.t_ns)
        self.carrier.refresh()
        self.carrier.send()


@pytest.fixture
def stand() -> Iterator[Stand]:
    made = Stand()
    yield made
    made.carrier.unplug()


def test_a_full_line_is_stuck_and_neutral_as_soon_as_it_moves(stand: Stand):
    assert stand.write() == SENT
    stand.read_all()
    assert stand.controller.output_V[:3] == pytest.approx(AWAY_V)
    stand.fill()
    assert stand.write() == SENT, "the driver keeps what the port did not take"
    assert is_stuck(stand.memory), "so that the thread hands over"
    assert not any(stand.step() for _ in range(64)), "no step waits, and none is taken for sent"
    stand.read_all()
    assert stand.controller.output_V[:3] == pytest.approx(AWAY_V)
    for _ in range(20):
        if stand.step():
            break
    stand.read_all()
    assert stand.controller.output_V[:3] == [50.0] * 3
    assert not is_stuck(stand.memory)


def test_a_line_that_is_not_full_yet_is_found_by_the_answer_that_does_not_come(stand: Stand):
    """ERR? is asked every 20 commands; a pty holds hundreds."""
    sent = 0
    while stand.write() == SENT:
        sent += 1
        assert sent < 100
    assert sent > ASK_ERROR_EVERY
    with pytest.raises(HalTimeout, match=r"no answer to 'ERR\?'"):
        raise_as_the_driver(stand)


def raise_as_the_driver(stand: Stand) -> None:
    """Ask the link for its error until its own clock says that the answer is late."""
    stand.driver.link.memory.asked_ns[0] -= 1_000 * MS
    stand.driver.link.take_error()
