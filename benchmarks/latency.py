"""(b) Sample to command over real ports, against a bare echo on a pty: what the machine and the bus cost anyway."""

from __future__ import annotations

import os
import pty
import subprocess
import sys
import time
import tty
from collections.abc import Iterator

import numpy as np

from benchmarks.row import Row
from firmware_py.app import LOOP_PRIORITY, RunRequest, run_in_process
from firmware_py.scheduler.realtime import RealtimeConfig, realtime
from tools.cli.bench_option import bench_path

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


def rows() -> Iterator[Row]:
    echo = echo_us()
    outcome, _ = run_in_process(RunRequest(bench_path(None), 5.0))
    latency = outcome["latency"]["sample_to_command_us"]
    bus_us = 16 * 9 / 0.4 + 12 / 0.4
    for name, share, must in (("p50", 50.0, True), ("p99", 99.0, False), ("p99_9", 99.9, False)):
        ours, peer = latency[name] - bus_us, float(np.percentile(echo, share))
        yield Row(
            f"sample to command, {name.replace('_', '.')}",
            f"scan instant to acknowledged DAC transfer, less the {bus_us:.0f} us of the emulated I2C bus at 400 kHz",
            ours, peer, "bare echo, same pty and policy", "us", ours / peer,
            "<= 1.5 x" if must else "-", ours <= 1.5 * peer if must else None, must=must,
            why="the sample crosses a pty and the command a socket, so two processes are woken where the echo wakes one"
            if must else "",
        )  # fmt: skip
