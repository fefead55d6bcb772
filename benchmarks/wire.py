"""(l) ``micron run --realtime``, compiled and in Python, beside the bare echo on the same carriers, in one run.

Serial bench: scans come and commands go over a pty each. Default bench: scans over a pty, commands over the socket of
the emulated I2C bus, whose own time is taken off. A bare echo does the same with nothing in between.
"""

from __future__ import annotations

import json
import os
import pty
import re
import socket
import subprocess
import sys
import tempfile
import threading
import time
import tty
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from benchmarks.row import Row
from drivers.piezo.dac_amplifier import WIRE_BITS
from firmware_py.app import run_in_process
from firmware_py.run_request import LOOP_PRIORITY, WORKER_PRIORITY, RunRequest
from firmware_py.scheduler.realtime import RealtimeConfig, realtime
from hal.backends.unix_i2c import HEAD, REPLY, SEGMENT
from hal.bench import OpenBench
from tools.cli.bench_option import bench_path

ECHOES = 2500
"""Answers of an echo at a time; it is measured before and after the runs."""
PACKET = 16
I2C_HZ = 400_000
BUS_NS = round(WIRE_BITS["command"] * 1e9 / I2C_HZ)
SEGMENTS = SEGMENT.pack(0, 3) + bytes(3)
COMPILED, PYTHON, SPINNING = "compiled", "Python", "compiled beside a thread that spins"
OF_PEER = RealtimeConfig(priority=LOOP_PRIORITY, idle_exit_us=0)
SETTINGS = RealtimeConfig(priority=LOOP_PRIORITY, idle_exit_us=0, worker_priority=WORKER_PRIORITY)
"""Settings of the echo and of what asks it, together those of the firmware: the echo is killed, and what it had
changed of the kernel would stay."""
GOALS = (("p50", 50.0, 1.5), ("p99", 99.0, 1.5), ("p99.9", 99.9, 2.0))
BESIDE_GOAL = 1.1
CORE_GOAL = 0.15
FAST_HZ = 4000
FAST_BUDGETS = (
    "sense = 10, estimate = 20, actuate = 10, publish = 5, supervise = 100, magnetometer = 200, telemetry = 100"
)
"""Budgets of tasks in a tick of 250 us; a read of the magnetometer takes all of one, beside the thread."""


class Setup(NamedTuple):
    """Describes a bench to be run: ``name`` in the rows, its file, ticks a second, the kinds of run, s of each, and the
    time in ns of the emulated bus that a command has to wait for."""

    name: str
    file: str
    tick_hz: int
    kinds: tuple[str, ...]
    run_s: float
    bus_ns: int

    @property
    def period_us(self) -> float:
        return 1e6 / self.tick_hz


SETUPS = (
    Setup("serial", "micron-e727.toml", 1000, (COMPILED, PYTHON, SPINNING), 10.0, 0),
    Setup("I2C", "micron.toml", 1000, (COMPILED, PYTHON, SPINNING), 6.0, BUS_NS),
    Setup("serial at 4 kHz", "micron-e727.toml", FAST_HZ, (COMPILED, PYTHON), 5.0, 0),
)


class Run(NamedTuple):
    """Holds the firmware's own figures of a run, and the ``core`` share of its process since the bench was open."""

    outcome: dict[str, Any]
    core: float

    def latency_us(self, name: str) -> float:
        return self.outcome["latency"]["sample_to_command_us"][name.replace(".", "_")]

    @property
    def without_command(self) -> float:
        """Share of scans, in %, that did not get a tick of their own: skipped, or caught up with in a later tick. The
        ones that came while the outputs were being armed are left out: nothing could be commanded then."""
        ticks = self.outcome["ticks"]
        arming = sum(one["caught_up"] + one["skipped_ticks"] for one in ticks["announced"].values())
        without = ticks["caught_up"] + ticks["skipped"] - arming
        return 100.0 * without / max(ticks["run"] + without, 1)

    @property
    def what(self) -> str:
        compiled, ticks = self.outcome.get("loop", {}).get("ticks", 0), self.outcome["ticks"]["run"]
        held, safe = len(self.outcome["holds"]), self.outcome["safe_state"]
        ended = "" if safe["normal"] else f"; ended early: {safe['reason']}"
        return f"{self.outcome['commands']['sent']} commands, {compiled} of {ticks} ticks compiled, {held} holds{ended}"


# -- the bare echo -----------------------------------------------------------------------------------------


def echo(path: str) -> None:
    """Be the far end of a pty: send every packet back."""
    fd = os.open(path, os.O_RDWR | os.O_NOCTTY)
    with realtime(OF_PEER):
        print("ready", flush=True)
        while True:
            os.write(fd, os.read(fd, PACKET))


def echo_to_bus(path: str, bus: str, n: int) -> None:
    """Be the far end of a pty: make a transfer on ``bus`` for every packet, and print when each was acknowledged."""
    fd = os.open(path, os.O_RDWR | os.O_NOCTTY)
    connection = socket.socket(socket.AF_UNIX, socket.SOCK_STREAM)
    connection.connect(bus)
    acknowledged_ns: list[int] = []
    with realtime(OF_PEER):
        print("ready", flush=True)
        for _ in range(n):
            os.read(fd, PACKET)
            connection.sendall(HEAD.pack(0x0C, 1, time.monotonic_ns()) + SEGMENTS)
            connection.recv(REPLY.size)
            acknowledged_ns.append(time.monotonic_ns())
    print(json.dumps(acknowledged_ns), flush=True)


def measure_echo(setup: Setup) -> np.ndarray:
    """Return the time in us from a packet to its answer, for packets at the rate of ``setup``: to the answer's arrival
    on the pty or, less the bus, to the acknowledgement of a transfer."""
    n = ECHOES * setup.tick_hz // 1000
    master, slave = pty.openpty()
    for fd in (master, slave):
        tty.setraw(fd)
    with tempfile.TemporaryDirectory(prefix="micron-") as folder, socket.socket(socket.AF_UNIX) as listener:
        listener.bind(f"{folder}/bus.sock")
        listener.listen(1)
        more = (
            ["to-bus", os.ttyname(slave), f"{folder}/bus.sock", str(n)] if setup.bus_ns else ["echo", os.ttyname(slave)]
        )
        command = [sys.executable, "-m", "benchmarks.wire", *more]
        with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as peer:
            try:
                assert peer.stdout is not None
                if peer.stdout.readline() != "ready\n":
                    raise RuntimeError("the echo did not start")
                bus = listener.accept()[0] if setup.bus_ns else None
                sent_ns, answered_ns = _ask(master, bus, n, round(setup.period_us * 1e3), setup.bus_ns)
                if bus is not None:
                    answered_ns = json.loads(peer.stdout.readline())
                    bus.close()
            finally:
                peer.kill()
    os.close(master)
    os.close(slave)
    return (np.array(answered_ns) - np.array(sent_ns) - setup.bus_ns) * 1e-3


def _ask(fd: int, bus: socket.socket | None, n: int, period_ns: int, bus_ns: int) -> tuple[list[int], list[int]]:
    """Send ``n`` packets and wait for the answer to each. Return when each was sent and answered, ns. A packet that was
    due before the answer to the one before it is sent then."""
    sent_ns: list[int] = []
    answered_ns: list[int] = []
    with realtime(SETTINGS):
        due_ns = time.monotonic_ns() + 100_000_000
        for _ in range(n):
            due_ns += period_ns
            time.sleep(max(0.0, (due_ns - time.monotonic_ns()) * 1e-9))
            sent_ns.append(time.monotonic_ns())
            os.write(fd, bytes(PACKET))
            if bus is None:
                got = 0
                while got < PACKET:
                    got += len(os.read(fd, PACKET - got))
            else:
                request = bus.recv(HEAD.size + len(SEGMENTS), socket.MSG_WAITALL)
                end_ns = HEAD.unpack_from(request)[2] + bus_ns
                while time.monotonic_ns() < end_ns:  # as the emulated world waits for the end of a transfer
                    pass
                bus.sendall(REPLY.pack(0, 0))
            answered_ns.append(time.monotonic_ns())
    return sent_ns, answered_ns


# -- the firmware ------------------------------------------------------------------------------------------


def bench_file(setup: Setup, folder: Path) -> Path:
    """Return the bench of ``setup``; one with another tick is a copy in ``folder``, calibration files by their path."""
    file = bench_path(None).with_name(setup.file)
    if setup.tick_hz == 1000:
        return file
    text = file.read_text(encoding="utf-8").replace('"calibration/piezo.toml", ', "")  # its taps are 1 ms apart
    text = re.sub(r'"(calibration/[^"]+)"', lambda m: f'"{file.parent / m[1]}"', text)
    text = re.sub(r"(?m)^(tick_hz|rate_hz) = 1000$", rf"\1 = {setup.tick_hz}", text)
    text = text.replace("[firmware]\n", f"[firmware]\nbudget_us = {{ {FAST_BUDGETS} }}\n")
    copy = folder / setup.file
    copy.write_text(text, encoding="utf-8")
    return copy


def _spin() -> None:
    while True:
        sum(range(100))


def run_all(setup: Setup) -> None:
    """Be the firmware of each kind of run, one after another, and print their ``Run`` as JSON."""
    found: list[tuple[dict[str, Any], float]] = []
    with tempfile.TemporaryDirectory(prefix="micron-") as folder:
        bench = bench_file(setup, Path(folder))
        for compiled in (True, False):  # everything is compiled or loaded
            run_in_process(RunRequest(bench, 0.05, pace="realtime", compiled=compiled))
        for kind in setup.kinds:
            if kind == SPINNING:
                threading.Thread(target=_spin, daemon=True).start()
            began: list[float] = []

            def on_open(opened: OpenBench, began: list[float] = began) -> None:
                began[:] = time.process_time(), time.thread_time(), time.monotonic()

            request = RunRequest(bench, setup.run_s, pace="realtime", compiled=kind != PYTHON)
            outcome, _ = run_in_process(request, on_open=on_open)
            core = (time.process_time() - began[0]) / (time.monotonic() - began[2])
            kept = ("latency", "ticks", "loop", "safe_state", "holds", "commands")
            found.append(({key: outcome[key] for key in kept if key in outcome}, core))
    print(json.dumps(found, default=str), flush=True)
    os._exit(0)


def measure_runs(setup: Setup) -> dict[str, Run]:
    """Return the run of each kind of ``setup``, made in a process of its own."""
    command = [sys.executable, "-m", "benchmarks.wire", "run", str(SETUPS.index(setup))]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    if done.returncode:
        raise RuntimeError(f"{setup.name}: {(done.stderr.strip().splitlines() or ['no reason'])[-1]}")
    made = [Run(*each) for each in json.loads(done.stdout.splitlines()[-1])]
    return dict(zip(setup.kinds, made, strict=True))


# -- rows --------------------------------------------------------------------------------------------------


def rows() -> Iterator[Row]:
    for setup in SETUPS:
        before = measure_echo(setup)
        runs = measure_runs(setup)
        bare = np.concatenate([before, measure_echo(setup)])
        for kind, run in runs.items():
            if setup.tick_hz == 1000:
                yield from latency_rows(setup, kind, run, bare)
            yield missed_row(setup, kind, run, bare)
        if SPINNING in runs:
            yield from beside_rows(setup, runs)
        yield from core_rows(setup, runs)


def latency_rows(setup: Setup, kind: str, run: Run, bare: np.ndarray) -> Iterator[Row]:
    for name, share, factor in GOALS:
        ours, peer = run.latency_us(name) - setup.bus_ns * 1e-3, float(np.percentile(bare, share))
        must = kind == COMPILED
        yield Row(
            f"sample to command, {setup.name}, {kind}, {name}", run.what, ours, peer, "bare echo, same carrier", "us",
            ours / peer, f"<= {factor:g} x" if must else "-", ours <= factor * peer if must else None, must=must,
            why=run.what if must else "",
        )  # fmt: skip


def missed_row(setup: Setup, kind: str, run: Run, bare: np.ndarray) -> Row:
    late = 100.0 * max(float(np.mean(bare >= setup.period_us)), 1.0 / len(bare))
    factor = 2.0 if setup.tick_hz == 1000 else 1.0
    must = kind == COMPILED
    return Row(
        f"ticks without a command, {setup.name}, {kind}", f"skipped or caught up with in a later tick; {run.what}",
        run.without_command, late, "echoes later than a period", "%", run.without_command / late,
        f"<= {factor:g} x" if must else "-", run.without_command <= factor * late if must else None, must=must,
        why="ticks of self-test and holds are Python's" if must else "",
    )  # fmt: skip


def beside_rows(setup: Setup, runs: dict[str, Run]) -> Iterator[Row]:
    for name, _, _ in GOALS[:2]:
        ours, peer = (runs[kind].latency_us(name) - setup.bus_ns * 1e-3 for kind in (SPINNING, COMPILED))
        yield Row(
            f"sample to command, {setup.name}, beside a thread that spins, {name}", "the GIL is never waited for",
            ours, peer, "the same alone", "us", ours / peer, f"<= {BESIDE_GOAL:g} x", ours <= BESIDE_GOAL * peer,
            must=True, why="both share two processors with the world",
        )  # fmt: skip


def core_rows(setup: Setup, runs: dict[str, Run]) -> Iterator[Row]:
    ours, peer = runs[COMPILED].core, runs[PYTHON].core
    must = setup.tick_hz == 1000
    yield Row(
        f"CPU of the firmware's process, {setup.name}, compiled", "self-test in it; recorder and world are others'",
        ours, peer, "Python", "cores", ours / peer, f"<= {CORE_GOAL:g} cores" if must else "-",
        ours <= CORE_GOAL if must else None, must=must, why="what runs beside the thread is Python" if must else "",
    )  # fmt: skip


ROLES: dict[str, Callable[[Sequence[str]], None]] = {
    "echo": lambda words: echo(words[0]),
    "to-bus": lambda words: echo_to_bus(words[0], words[1], int(words[2])),
    "run": lambda words: run_all(SETUPS[int(words[0])]),
}

if __name__ == "__main__":
    ROLES[sys.argv[1]](sys.argv[2:])
