"""(b) Sample to command over real ports, against a bare echo on a pty: what the machine and the bus cost anyway."""

from __future__ import annotations

import os
import pty
import subprocess
import sys
import time
import tty
from collections.abc import Iterator
from typing import Any

import numpy as np

from benchmarks.row import Row
from firmware_py.app import run_in_process
from firmware_py.run_request import LOOP_PRIORITY, RunRequest
from firmware_py.scheduler.realtime import RealtimeConfig, realtime
from tools.cli.bench_option import bench_path

BUS_US = 16 * 9 / 0.4 + 12 / 0.4
"""16 bytes and their conditions on the emulated I2C bus at 400 kHz; the emulated USB adds nothing in real time."""
ECHO = """
import os, sys, serial
port = serial.Serial(sys.argv[1], timeout=None)
while True:
    data = port.read(16)
    port.write(data)
"""


def echo_us(n: int = 3000) -> np.ndarray:
    """Round trip of one 16-byte packet a millisecond to a process that sends it back with pyserial, us each.

    Both ends ask for the policy that the firmware and its emulated world get.
    """
    master, slave = pty.openpty()
    tty.setraw(master)
    tty.setraw(slave)
    times_ns = []
    peer = subprocess.Popen([sys.executable, "-c", ECHO, os.ttyname(slave)])
    try:
        with realtime(RealtimeConfig(priority=LOOP_PRIORITY)):
            due_ns = time.monotonic_ns() + 1_000_000_000
            for _ in range(n):
                due_ns += 1_000_000
                time.sleep(max(0.0, (due_ns - time.monotonic_ns()) * 1e-9))
                sent_ns = time.monotonic_ns()
                os.write(master, bytes(16))
                got = 0
                while got < 16:
                    got += len(os.read(master, 16 - got))
                times_ns.append(time.monotonic_ns() - sent_ns)
    finally:
        peer.kill()
        peer.wait()
        os.close(master)
        os.close(slave)
    return np.array(times_ns) * 1e-3


SECONDS = 5.0
TASKS = ("sense", "estimate", "actuate")


def rows() -> Iterator[Row]:
    echo = echo_us()
    run_in_process(RunRequest(bench_path(None), 0.5))  # kernels compiled or read, here and in the emulated world
    outcome, _ = run_in_process(RunRequest(bench_path(None), SECONDS))
    if not outcome["safe_state"]["normal"]:
        raise RuntimeError(f"the run ended early, nothing to measure: {outcome['safe_state']['reason']}")
    latency = outcome["latency"]["sample_to_command_us"]
    for name, share, must in (("p50", 50.0, True), ("p99", 99.0, False), ("p99_9", 99.9, False)):
        ours, peer = latency[name] - BUS_US, float(np.percentile(echo, share))
        yield Row(
            f"sample to command, {name.replace('_', '.')}",
            f"scan instant to acknowledged DAC transfer, less the {BUS_US:.0f} us of the emulated I2C bus at 400 kHz",
            ours, peer, "bare echo, same pty and policy", "us", ours / peer,
            "<= 1.5 x" if must else "-", ours <= 1.5 * peer if must else None, must=must,
            why="four wake-ups of a process where the echo has two (world to sample, firmware by the bytes, world by "
            "the transfer, firmware by its answer); see the parts" if must else "",
        )  # fmt: skip
    for what, ours in parts_us(outcome):
        yield Row(
            f"sample to command, {what}", "p50 of this part; the bus times of the emulation are in it", ours,
            latency["p50"], "the whole", "us", ours / latency["p50"],
        )  # fmt: skip


def parts_us(outcome: dict[str, Any]) -> Iterator[tuple[str, float]]:
    """Where the time goes, p50 of each part: they follow each other within a tick."""
    yield "scan to firmware awake", outcome["ticks"]["lateness_us"]["p50"]
    for task in TASKS:
        yield f"task {task}", outcome["tasks"][task]["duration_us"]["p50"]
