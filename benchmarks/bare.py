"""The bare loop: reads the scans of an emulated bench and sends a command, and does nothing in between.

It uses the wires, the emulated world, the priorities and the estimate of a scan's instant that the firmware uses. What
the host or the world is late for is in its figures as it is in the firmware's. With ``polls`` a Python thread asks the
slow converters of the bench as often as the firmware does: what the world owes to them is in the figures then.
"""

from __future__ import annotations

import json
import os
import sys
import threading
from collections.abc import Callable, Generator
from contextlib import ExitStack, contextmanager, nullcontext
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from benchmarks import socket_line
from benchmarks.machine import stolen_ms
from drivers.daq.di4108 import Di4108
from drivers.daq.di4108_kernels import READY, accept, decode
from drivers.piezo.dac_output import DacOutput
from drivers.piezo.e727 import E727
from firmware_py.control.wiring import Devices, open_devices
from firmware_py.machine.waiting import kept_waiting_ns
from firmware_py.machine.workers import WORKER_PRIORITY
from firmware_py.run_request import LOOP_PRIORITY, RunRequest, open_requested
from firmware_py.scheduler.realtime import RealtimeConfig, realtime
from hal.backends.unix_i2c import UnixI2c
from hal.bench import load_bench
from hal.compiled import thread_kernel
from hal.contracts import Clock
from hal.fd_kernels import EAGAIN, POLLIN, now_ns, poll_word, read_fd, wait_fds, write_fd
from hal.i2c_carrier import PYTHON
from hal.i2c_kernels import Transfer, new_transfer, transfer

SETTINGS = RealtimeConfig(priority=LOOP_PRIORITY, idle_exit_us=0, worker_priority=WORKER_PRIORITY)
SILENT_NS = 1_000_000_000
WARM_UP = 50
"""Scans before the first command that is measured."""
MONITOR_NS, MAGNETOMETER_NS = 2_500_000, 3_333_333
"""Times between two transfers with the converters of the default bench (``drivers.polling``)."""
COMMAND = b"SVA 1 50.0000 2 50.0000 3 50.0000\n"
COMMANDS_HZ = 100
"""Commands a second of an E-727, as the firmware sends them."""
SCANS, LATE, SENT, DT_NS, EVERY, DAQ_FD, OUTPUT_FD = range(7)
"""Places in ``words``. ``LATE``: scans that came together with a newer one; ``EVERY``: scans between two commands."""


class Bare(NamedTuple):
    """Holds the times of a bare loop from scan to command, us, the share of scans that had no command of their own
    because they came with a newer one, %, the time in ms that the host took from the machine, the time in ms for
    which the kernel kept the loop waiting, and the number of the world's pauses and the longest one in ms."""

    late_us: list[float]
    without_command: float
    stolen_ms: float
    kept_waiting_ms: float
    pauses: int
    longest_pause_ms: float

    @property
    def host(self) -> str:
        """Say what host and kernel did meanwhile."""
        world = f"{self.pauses} pauses of the world (longest {self.longest_pause_ms:.1f} ms)"
        return f"host took {self.stolen_ms:g} ms, kernel {self.kept_waiting_ms:.1f} ms, {world}"


@thread_kernel
def serve(
    words: NDArray[np.int64], stream: Any, buffer: NDArray[np.uint8], rows: NDArray[np.int16], text: NDArray[np.uint8],
    command: Transfer, late_ns: NDArray[np.int64],
) -> bool:  # fmt: skip
    """Send a command, ``text`` or else ``command``, after every ``EVERY`` scans until ``late_ns`` is full of the times
    from scan to command. Return False if the scans end before."""
    polls = np.zeros(1, np.int64)
    while words[SENT] < len(late_ns):
        polls[0] = poll_word(words[DAQ_FD], POLLIN)
        if wait_fds(polls, now_ns() + SILENT_NS) <= 0:
            return False
        end = stream[0].end
        got = read_fd(words[DAQ_FD], buffer, end, len(buffer))
        if got == -EAGAIN:
            continue
        if got <= 0:
            return False
        if accept(stream, buffer, got, now_ns()) != READY:
            continue
        n, t0_ns, _, _, _ = decode(stream, buffer, rows)
        words[SCANS] += n
        words[LATE] += n - 1
        if words[SCANS] // words[EVERY] == (words[SCANS] - n) // words[EVERY]:
            continue
        if len(text) > 0:
            write_fd(words[OUTPUT_FD], text, len(text), 0)
        else:
            transfer(command, words[OUTPUT_FD])
        late_ns[words[SENT]] = now_ns() - (t0_ns + (n - 1) * words[DT_NS])
        words[SENT] += 1
    return True


@contextmanager
def polled(devices: Devices, clock: Clock) -> Generator[None]:
    """Let a Python thread ask the slow converters of ``devices``, one at a time, for the length of the block."""
    polls: list[tuple[Callable[[], object], int]] = []
    if devices.monitor is not None:
        polls.append((devices.monitor.poll, MONITOR_NS))
    if devices.magnetometer is not None:
        polls.append((devices.magnetometer.poll, MAGNETOMETER_NS))
    is_over = threading.Event()

    def run() -> None:
        os.sched_setscheduler(0, os.SCHED_OTHER, os.sched_param(0))
        due_ns = [clock.now_ns()] * len(polls)
        while not is_over.is_set():
            i = due_ns.index(min(due_ns))
            clock.sleep_until_ns(due_ns[i])
            poll, every_ns = polls[i]
            poll()
            due_ns[i] = max(due_ns[i] + every_ns, clock.now_ns())

    thread = threading.Thread(target=run)
    thread.start()
    try:
        yield
    finally:
        is_over.set()
        thread.join()


def measure(file: Path, seconds: float, tick_hz: int, *, polls: bool = False) -> Bare:
    """Run the bare loop on the bench of ``file``."""
    bench = load_bench(file)
    with open_requested(RunRequest(file, seconds, pace="realtime"), bench, None) as opened, ExitStack() as stack:
        devices = open_devices(opened)
        daq, output = devices.daq, devices.amplifier
        assert isinstance(daq, Di4108)
        port: Any = daq.port
        words = np.zeros(7, np.int64)
        words[DT_NS], words[EVERY], words[DAQ_FD] = daq.dt_ns, 1, port.fileno()
        text, command = np.zeros(0, np.uint8), new_transfer(PYTHON, 0, ())
        output.arm()
        if isinstance(output, E727):
            line: Any = output.port
            text = np.frombuffer(COMMAND, np.uint8).copy()
            words[OUTPUT_FD], words[EVERY] = line.fileno(), tick_hz // COMMANDS_HZ
        else:
            assert isinstance(output, DacOutput)
            assert isinstance(output.bus, UnixI2c)
            bus = output.bus.for_thread()
            stack.callback(bus.close)
            command = new_transfer(bus.CARRIER, output.address, output.segments(0x8000, 0x8000, 0x8000))
            words[OUTPUT_FD] = bus.fileno()
        late_ns = np.zeros(round(seconds * tick_hz / words[EVERY]), np.int64)
        rows = np.zeros((1024, 8), np.int16)
        stream, buffer = daq.memory
        serve(words, stream, buffer, rows, text, command, late_ns[:0])  # compiled or loaded
        with realtime(SETTINGS):
            daq.start()
            if serve(words, stream, buffer, rows, text, command, np.zeros(WARM_UP, np.int64)):
                words[SCANS] = words[LATE] = words[SENT] = 0
                before_ms, before_ns = stolen_ms(), kept_waiting_ns()
                with polled(devices, opened.clock) if polls else nullcontext():
                    is_whole = serve(words, stream, buffer, rows, text, command, late_ns)
            else:
                is_whole, before_ms, before_ns = False, 0.0, 0
            taken_ms, waited_ms = stolen_ms() - before_ms, (kept_waiting_ns() - before_ns) * 1e-6
            pauses, longest_ms = opened.world.stalls() if opened.world is not None else (0, 0.0)
        if not is_whole:
            raise RuntimeError("the scans ended before the bare loop did")
        daq.stop()
        output.close()
    late = 100.0 * words[LATE] / words[SCANS]
    return Bare((late_ns * 1e-3).tolist(), late, taken_ms, waited_ms, pauses, longest_ms)


if __name__ == "__main__":
    if "sockets" in sys.argv[4:]:
        socket_line.install()
    print(
        json.dumps(measure(Path(sys.argv[1]), float(sys.argv[2]), int(sys.argv[3]), polls="polls" in sys.argv[4:])),
        flush=True,
    )
