"""Sample to command over real ports, against a bare echo on a pty: what the machine and the bus cost anyway."""

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
from firmware_py.app import RunRequest, run_in_process
from tools.cli.bench_option import bench_path

ECHO = """
import os, sys, serial
port = serial.Serial(sys.argv[1], timeout=None)
while True:
    data = port.read(16)
    port.write(data)
"""


def echo_us(n: int = 3000) -> float:
    """Median round trip of one 16-byte packet a millisecond to a process that sends it back with pyserial."""
    master, slave = pty.openpty()
    tty.setraw(master)
    tty.setraw(slave)
    peer = subprocess.Popen([sys.executable, "-c", ECHO, os.ttyname(slave)])
    times_ns = []
    try:
        due_ns = time.monotonic_ns() + 300_000_000
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
    return float(np.median(times_ns)) * 1e-3


def rows() -> Iterator[Row]:
    echo = echo_us()
    outcome, _ = run_in_process(RunRequest(bench_path(None), 5.0))
    ours = outcome["latency"]["sample_to_command_us"]["p50"]
    bus_us = 16 * 9 / 0.4 + 12 / 0.4
    yield Row(
        "sample to command, p50",
        f"scan instant to acknowledged DAC transfer; {bus_us:.0f} us of it is the emulated I2C bus at 400 kHz",
        ours,
        echo,
        "bare echo on a pty",
        "us",
        ours / echo,
        "bus time subtracted <= 1.5 x",
        (ours - bus_us) / echo <= 1.5,
    )
