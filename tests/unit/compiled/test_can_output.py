"""Commands of compiled code to the emulated CAN node over its socket: what arrives, and what a full socket does."""

from __future__ import annotations

import os
import select
import socket
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from drivers.can_frames import BEATS
from drivers.piezo.can_amplifier import CanAmplifier
from drivers.piezo.can_node import ACKNOWLEDGED, COUNTER, COUNTER_LAG_LIMIT, LAGS, LEFT, STATUS_NS, link_fault
from drivers.piezo.e727_loop import HANDED_OVER, SENT
from firmware_py.compiled import outputs
from firmware_py.compiled.sides import CanSide
from hal.backends.unix_can import UnixCan
from hal.clock import MonotonicClock
from hal.compiled import thread_kernel
from hal.errors import HalTimeout
from hal.types import CanFrame
from sim_devices.devices.can_piezo_node import NEUTRAL, CanPiezoNode
from sim_devices.transports.can_hub import CanHub
from sim_devices.transports.can_socket import CanSocketServer

MS = 1_000_000


@thread_kernel
def write(out: Any, fd: int, values_V: NDArray[np.float64]) -> tuple[int, int]:
    return outputs.write(out, fd, values_V, 0)


@thread_kernel
def step_ramp(out: Any, fd: int) -> bool:
    return outputs.step_ramp(out, fd, 0)


class Stand:
    """A node that is armed, its hub and socket, and the compiled side of the driver. The test moves their time."""

    def __init__(self, folder: Path) -> None:
        self.hub, self.node, self.t_ns = CanHub(500_000), CanPiezoNode(), 0
        self.hub.attach(self.node)
        self.server = CanSocketServer(self.hub, folder / "can.sock")
        self.clock = clock = MonotonicClock()
        self.bus = UnixCan(str(folder / "can.sock"), clock)
        self.driver = CanAmplifier(self.bus, clock)
        self.side = CanSide(self.driver, clock)
        self.now_ns = np.array([clock.now_ns()])
        self.memory = self.side.memory(self.now_ns)
        self.pass_ms(8)
        self.bus.send(_command(1), 0.0)
        self.pass_ms(5)  # the node arms, and says so in a STATUS
        self.driver.poll()
        self.now_ns[0] = clock.now_ns()  # the driver has used the real clock, and loading kernels takes a while
        self.driver.node.words[COUNTER] = self.driver.node.words[ACKNOWLEDGED] + 1  # as ``arm`` does
        self.driver.guard.armed = True
        assert self.driver.state == 1

    def pass_ms(self, n: int, *, reads: bool = True) -> None:
        """Let ``n`` ms of the node's time pass; the world ``reads`` what was sent."""
        for _ in range(n):
            while reads and (ready := select.select(self.server.filenos(), (), (), 0.0)[0]):
                for fileno in ready:
                    self.server.pump(fileno, self.t_ns)
            self.t_ns += MS
            self.now_ns += MS
            self.hub.advance_to(self.t_ns)
            # frames are stamped by the real clock, which must not be behind the time that the test has moved
            self.clock.sleep_until_ns(int(self.now_ns[0]))

    def has_unread(self) -> bool:
        """Return True while frames wait on the thread's own connection."""
        return bool(select.select([self.side.fileno()], (), (), 0.0)[0])

    def write(self, *volts: float) -> int:
        return write(self.memory, self.side.fileno(), np.array(volts))[0]

    def make_room_small(self) -> None:
        """Let the thread's socket take a few frames only."""
        with socket.socket(fileno=os.dup(self.side.fileno())) as same:
            same.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, 1)

    def close(self) -> None:
        self.side.close()
        self.bus.close()
        self.server.close()


def _command(order: int) -> CanFrame:
    return CanFrame(0x122, bytes((order, order ^ 0xFF)))


@pytest.fixture
def stand(tmp_path: Path) -> Iterator[Stand]:
    made = Stand(tmp_path)
    yield made
    made.close()


def test_set_points_and_the_heartbeat_arrive(stand: Stand):
    before = stand.driver.heartbeat.sent
    for k in range(30):
        assert stand.write(50.0 + 0.01 * k, 49.0, 51.0) == SENT
        stand.pass_ms(1)
    assert stand.node.output_V == pytest.approx([50.29, 49.0, 51.0], abs=0.001)
    assert (stand.node.accepted, stand.node.rejected, stand.node.counter_gaps) == (30, 0, 0)
    assert 1 <= stand.driver.heartbeat.words[BEATS] - before <= 2, "30 ms at 50 Hz"
    assert stand.driver.node.words[STATUS_NS] > 0
    assert stand.driver.commanded_V == pytest.approx([50.29, 49.0, 51.0])


def test_a_full_socket_is_handed_over_and_the_nodes_watchdog_ramps(stand: Stand):
    """The world stops reading; the node hears no set point for 10 ms and needs 10 ms for its ramp at most."""
    assert stand.write(60.0, 40.0, 50.0) == SENT
    stand.pass_ms(1)
    assert max(abs(v - 50.0) for v in stand.node.output_V) > 1.0
    stand.make_room_small()
    sent = 0
    while stand.write(60.0, 40.0, 50.0) == SENT:
        sent += 1
    assert 0 < sent < COUNTER_LAG_LIMIT, "more would be found by the node's silence about them"
    stand.side.take_over(False)
    stand.side.catch_up()
    assert not stand.side.is_well
    with pytest.raises(HalTimeout, match="queue is full"):
        stand.driver.write(np.array([60.0, 40.0, 50.0]))
    assert stand.driver.pending is None
    stand.pass_ms(21, reads=False)
    assert stand.node.codes == [NEUTRAL] * 3
    assert stand.node.watchdog_trips == 1


def test_set_points_that_no_status_acknowledges_are_handed_over(stand: Stand):
    sent = 0
    while stand.write(60.0, 40.0, 50.0) == SENT:
        sent += 1
    assert sent == COUNTER_LAG_LIMIT + 1
    assert link_fault(stand.driver.node, int(stand.now_ns[0])) == LAGS


def test_a_node_that_leaves_the_armed_state_is_handed_over(stand: Stand):
    stand.bus.send(_command(0), 0.0)
    stand.pass_ms(15)
    assert stand.write(50.0, 50.0, 50.0) == HANDED_OVER
    stand.side.take_over(False)
    assert stand.driver.pending is None, "the driver's own write finds it again"
    assert link_fault(stand.driver.node, int(stand.now_ns[0])) == LEFT


def test_the_ramp_is_over_when_the_node_says_so(stand: Stand):
    assert stand.write(60.0, 40.0, 50.0) == SENT
    done = False
    for _ in range(40):
        done = step_ramp(stand.memory, stand.side.fileno())
        if done:
            break
        stand.pass_ms(1)
    assert done
    assert stand.node.codes == [NEUTRAL] * 3
    assert list(stand.driver.commanded_V) == [50.0] * 3


def test_what_the_node_said_before_the_thread_ran_is_passed_over(stand: Stand) -> None:
    """Its connection was made before the node was armed, and received that."""
    assert stand.has_unread()
    stand.side.begin()
    assert not stand.has_unread()
    assert stand.write(50.0, 50.0, 50.0) == SENT
    assert stand.driver.state == 1
