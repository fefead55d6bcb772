"""(b) Sample to command over real ports, against a bare echo on a pty: what the machine and the bus cost anyway."""

from __future__ import annotations

import os
import pty
import subprocess
import sys
import time
import tty
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.row import Row
from benchmarks.yardstick import compiler
from firmware_py.app import run_in_process
from firmware_py.run_request import LOOP_PRIORITY, RunRequest
from firmware_py.scheduler.realtime import RealtimeConfig, realtime
from tools.cli.bench_option import bench_path

BUS_US = 16 * 9 / 0.4 + 12 / 0.4
"""16 bytes and their conditions on the emulated I2C bus at 400 kHz; the emulated USB adds nothing in real time."""
ECHO = """
import sys, serial
port = serial.Serial(sys.argv[1], timeout=None)
print("ready", flush=True)
while True:
    data = port.read(16)
    port.write(data)
"""
STEP_ECHO = """
import sys, serial
from benchmarks import step_input
from benchmarks.yardstick import Yardstick
from firmware_py.frame import STATUS, VOLTS
stages, rows = step_input.settled(int(sys.argv[2]))
frame, c = stages.frame, Yardstick(stages)
port = serial.Serial(sys.argv[1], timeout=None)
print("ready", flush=True)
for row in rows:
    data = port.read(16)
    frame[:VOLTS] = row[:VOLTS]
    frame[STATUS] = row[STATUS]
    c.step()
    port.write(data)
"""
ECHOES = 3000
SECONDS = 5.0
TASKS = ("sense", "estimate", "actuate")
SHARES = (("p50", 50.0, True), ("p99", 99.0, False), ("p99_9", 99.9, False))
SERIAL = "micron-e727.toml"
"""Scans come and commands go over a pty each; the line carries a command every 10 ms, and only those are counted."""


def echo_us(script: str = ECHO) -> np.ndarray:
    """Round trips of one 16-byte packet a millisecond to a process that sends it back with pyserial, us each.

    Both ends ask for the policy that the firmware and its emulated world get.
    """
    master, slave = pty.openpty()
    tty.setraw(master)
    tty.setraw(slave)
    times_ns = []
    command = [sys.executable, "-c", script, os.ttyname(slave), str(ECHOES)]
    peer = subprocess.Popen(command, stdout=subprocess.PIPE)
    try:
        assert peer.stdout is not None
        if not peer.stdout.readline():
            raise RuntimeError("the echo did not start")
        with realtime(RealtimeConfig(priority=LOOP_PRIORITY)):
            due_ns = time.monotonic_ns() + 100_000_000
            for _ in range(ECHOES):
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


def outcome_of(bench: Path) -> dict[str, Any]:
    run_in_process(RunRequest(bench, 0.5, pace="realtime"))  # kernels compiled or read, here and in the emulated world
    outcome, _ = run_in_process(RunRequest(bench, SECONDS, pace="realtime"))
    if not outcome["safe_state"]["normal"]:
        raise RuntimeError(f"the run ended early, nothing to measure: {outcome['safe_state']['reason']}")
    return outcome


def against(
    latency: dict[str, float], echo: np.ndarray, where: str, what: str, less_us: float, why: str
) -> Iterator[Row]:
    for name, share, must in SHARES:
        ours, peer = latency[name] - less_us, float(np.percentile(echo, share))
        yield Row(
            f"sample to command, {where}, {name.replace('_', '.')}", what, ours, peer, "bare echo, pty, same policy",
            "us", ours / peer, "<= 1.5 x" if must else "-", ours <= 1.5 * peer if must else None, must=must,
            why=why if must else "",
        )  # fmt: skip


def rows() -> Iterator[Row]:
    echo = echo_us()
    outcome = outcome_of(bench_path(None).with_name(SERIAL))
    latency = outcome["latency"]["sample_to_command_us"]
    yield from against(
        latency, echo, "serial", "scan instant to the command's bytes in the port; scans and commands over a pty", 0.0,
        "two processes in Python, checks of every scan, a step with cold caches; see the parts and the C step's echo",
    )  # fmt: skip
    yield from parts(outcome, "serial")
    if compiler() is not None:
        peer, stepping = float(np.median(echo)), float(np.median(echo_us(STEP_ECHO)))
        yield Row(
            "bare echo with the C step in it", "p50; nothing is checked, recorded or supervised: what is left to reach",
            stepping, peer, "bare echo, pty, same policy", "us", stepping / peer,
        )  # fmt: skip
    outcome = outcome_of(bench_path(None))
    yield from against(
        outcome["latency"]["sample_to_command_us"], echo, "I2C",
        f"scan instant to acknowledged DAC transfer, less the {BUS_US:.0f} us of the emulated I2C bus at 400 kHz",
        BUS_US,
        "four wake-ups of a process where the echo has two (world to sample, firmware by the bytes, world by "
        "the transfer, firmware by its answer); see the parts",
    )  # fmt: skip
    yield from parts(outcome, "I2C")


def parts(outcome: dict[str, Any], where: str) -> Iterator[Row]:
    """Where the time goes, p50 of each part: they follow each other within a tick."""
    whole = outcome["latency"]["sample_to_command_us"]["p50"]
    found = {"scan to firmware awake": outcome["ticks"]["lateness_us"]["p50"]}
    found |= {f"task {task}": outcome["tasks"][task]["duration_us"]["p50"] for task in TASKS}
    for what, ours in found.items():
        yield Row(
            f"sample to command, {where}, {what}", "p50 of this part over all ticks, with and without a command", ours,
            whole, "the whole", "us", ours / whole,
        )  # fmt: skip
