"""The mark of death: set by the kernel before it closes a single descriptor, however the owner ends."""

from __future__ import annotations

import os
import select
import subprocess
import threading
import time

import numpy as np
import pytest

from drivers.piezo.dac_amplifier import DacAmplifier
from firmware_py.guardian.guardian import Guardian, State
from firmware_py.guardian.heartbeat import Heartbeat, Phase, TakeoverReason
from firmware_py.guardian.process import run_guardian
from hal.children import child_command, child_environment
from hal.clock import MonotonicClock
from sim_devices.devices.ad5696r import Ad5696r
from sim_devices.transports.i2c_line import I2cLine

OWNER = """
import sys, time
from firmware_py.guardian.heartbeat import Heartbeat
heartbeat = Heartbeat(int(sys.argv[1]))
assert heartbeat.mark.hold()
ballast = bytearray(80_000_000)
print("holds", flush=True)
time.sleep(600.0)
"""


class Owner:
    """A process that holds the mark of ``heartbeat`` and the writing end of ``pipe``, beside much memory."""

    def __init__(self) -> None:
        self.heartbeat = Heartbeat.shared()
        assert self.heartbeat.fd is not None
        self.pipe, theirs = os.pipe()
        interpreter = child_command("x")[0]
        self._process = subprocess.Popen(
            [interpreter, "-c", OWNER, str(self.heartbeat.fd)],
            stdout=subprocess.PIPE,
            pass_fds=(self.heartbeat.fd, theirs),
            env=child_environment(),
        )
        os.close(theirs)
        assert self._process.stdout is not None
        assert self._process.stdout.readline() == b"holds\n"

    def kill(self) -> None:
        """Return when the kernel has closed the pipe of the dead."""
        self._process.kill()
        assert select.select([self.pipe], (), (), 60.0)[0]

    def close(self) -> None:
        self._process.kill()
        self._process.communicate()
        os.close(self.pipe)


@pytest.fixture
def owner():
    made = Owner()
    yield made
    made.close()


def test_the_mark_is_set_before_the_pipe_closes(owner: Owner):
    assert not owner.heartbeat.mark.owner_died
    owner.kill()
    assert owner.heartbeat.mark.owner_died


def test_the_guardian_answers_to_the_mark_although_the_pipe_stays_open(owner: Owner):
    """The kernel frees the memory of the dead before it closes their pipes; this pipe is never closed."""
    clock = MonotonicClock()
    line = I2cLine(400_000)
    dac = Ad5696r(on_output=lambda channel, volts, t_ns: None)
    line.attach(0x0C, dac)

    class Immediate:
        """I2cBus of the emulated line, without bus time."""

        def transfer(self, address, ops):
            transfer = line.transfer(address, ops, clock.now_ns())
            while True:
                try:
                    next(transfer)
                except StopIteration as done:
                    return done.value[1]

    amplifier = DacAmplifier(Immediate(), clock)  # type: ignore[arg-type]
    amplifier.arm()
    while amplifier.commanded_V[0] < 60.0:
        amplifier.write(np.array([70.0, 30.0, 50.0]))
    guardian = Guardian(owner.heartbeat, DacAmplifier(Immediate(), clock), clock, notice_ms=1e6, limit_ms=1e6)  # type: ignore[arg-type]
    owner.heartbeat.set_phase(Phase.RUNNING)
    owner.heartbeat.beat(clock.now_ns())
    never_closed, writer = os.pipe()
    owner.kill()
    run_guardian(guardian, owner.heartbeat, clock, never_closed)
    assert (guardian.state, owner.heartbeat.reason) == (State.DONE, TakeoverReason.DIED)
    assert [round(20.0 * volts, 2) for volts in dac.output_V[:3]] == [50.0] * 3
    for descriptor in (never_closed, writer):
        os.close(descriptor)


@pytest.mark.parametrize("dies", [True, False])
def test_a_thread_that_ends_with_the_mark_is_dead_and_one_that_released_it_is_not(dies: bool):
    heartbeat = Heartbeat.shared()

    def work() -> None:
        assert heartbeat.mark.hold()
        if not dies:
            heartbeat.mark.release()

    thread = threading.Thread(target=work)
    thread.start()
    thread.join()
    deadline_s = time.monotonic() + 60.0
    while dies and not heartbeat.mark.owner_died and time.monotonic() < deadline_s:
        time.sleep(0.001)  # the thread of the system ends a little after Python's
    assert heartbeat.mark.owner_died is dies


def test_in_private_memory_nobody_dies():
    assert not Heartbeat().mark.owner_died
