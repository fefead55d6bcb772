"""(l) Sample to command in one compiled thread, against the bare echo on the same carrier, in the same run."""

from __future__ import annotations

import json
import os
import pty
import socket
import subprocess
import sys
import tempfile
import threading
import time
import tty
from collections.abc import Iterator
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from benchmarks import step_input
from benchmarks.latency import SERIAL, echo_us
from benchmarks.row import Row
from firmware_py.app import run_in_process
from firmware_py.frame import COUNTS
from firmware_py.run_request import LOOP_PRIORITY, RunRequest
from firmware_py.scheduler.realtime import RealtimeConfig, realtime
from tools.cli.bench_option import bench_path

TICKS = 3000
PERIOD_NS = 1_000_000
PACKET = 16
BARE, FREE, STEP, BESIDE = "bare", "compiled echo", "step", "step beside a spinning thread"
KINDS = (BARE, FREE, STEP, BESIDE, BARE)
"""In the order of measurement; the bare echo is measured before and after."""
GOALS = (("p50", 50.0, 1.5), ("p99", 99.0, 1.5), ("p99.9", 99.9, 2.0))
BESIDE_GOAL = 1.1
RUN_S = 8.0
ALONE, SPINNING, RECORDING = "alone", "beside a spinning thread", "beside the recorder"


class Measured(NamedTuple):
    """``times_us`` of each answer, and the ``core`` share that the answering process took."""

    times_us: np.ndarray
    core: float


def answer(kind: str, fd: int) -> None:
    """Be the far end: answer TICKS packets on ``fd``, then print the CPU time that it took, in s."""
    from benchmarks import wire_loop

    stages = step_input.settled(0)[0] if kind in (STEP, BESIDE) else None
    if stages is not None:
        wire_loop.serve_port(stages, fd, 0)  # compiles or loads
    elif kind == FREE:
        wire_loop.echo(fd, 0, np.zeros(64, np.uint8))
    if kind == BESIDE:
        threading.Thread(target=_spin, daemon=True).start()
    with realtime(RealtimeConfig(priority=LOOP_PRIORITY)):
        print("ready", flush=True)
        before_s = time.thread_time()
        if stages is not None:
            ended = wire_loop.serve_port(stages, fd, TICKS)
        elif kind == FREE:
            ended = wire_loop.echo(fd, TICKS, np.zeros(64, np.uint8))
        else:
            os.set_blocking(fd, True)
            ended = wire_loop.ENDED
            for _ in range(TICKS):
                os.write(fd, os.read(fd, PACKET))
        print(time.thread_time() - before_s if ended == wire_loop.ENDED else f"ended: {ended}", flush=True)
    os._exit(0)


def _spin() -> None:
    while True:
        sum(range(100))


def carrier(kind: str) -> tuple[int, int]:
    """Return our end and the far one, a socket pair's or a pty's."""
    if kind == "socket pair":
        a, b = socket.socketpair()
        return a.detach(), b.detach()
    master, slave = pty.openpty()
    tty.setraw(master)
    tty.setraw(slave)
    return master, slave


def measure(kind: str, where: str, packets: list[bytes]) -> Measured:
    """A packet a millisecond, each sent when the one before has been answered."""
    ours, far = carrier(where)
    os.set_blocking(far, kind == BARE)
    command = [sys.executable, "-m", "benchmarks.wire", kind, str(far)]
    peer = subprocess.Popen(command, stdout=subprocess.PIPE, text=True, pass_fds=[far])
    times_ns = []
    try:
        assert peer.stdout is not None
        if peer.stdout.readline() != "ready\n":
            raise RuntimeError(f"{kind} on a {where} did not start")
        os.close(far)
        with realtime(RealtimeConfig(priority=LOOP_PRIORITY)):
            began_ns = time.monotonic_ns()
            due_ns = began_ns + 100_000_000
            for packet in packets:
                due_ns += PERIOD_NS
                time.sleep(max(0.0, (due_ns - time.monotonic_ns()) * 1e-9))
                sent_ns = time.monotonic_ns()
                os.write(ours, packet)
                got = b""
                while not (got.endswith(b"\n") if kind in (STEP, BESIDE) else len(got) == PACKET):
                    piece = os.read(ours, 256)
                    if not piece:
                        raise RuntimeError(f"{kind} on a {where} stopped: {peer.stdout.readline().strip()}")
                    got += piece
                times_ns.append(time.monotonic_ns() - sent_ns)
            wall_s = (time.monotonic_ns() - began_ns) * 1e-9
        cpu_s = float(peer.stdout.readline())
    finally:
        peer.kill()
        peer.wait()
        os.close(ours)
    return Measured(np.array(times_ns) * 1e-3, cpu_s / wall_s)


def rows() -> Iterator[Row]:
    counts = step_input.settled(TICKS)[1][:, COUNTS : COUNTS + 8].astype("<i2")
    packets = [row.tobytes() for row in counts]
    for where in ("socket pair", "pty"):
        runs = [(kind, measure(kind, where, packets)) for kind in KINDS]
        times = {kind: np.concatenate([run.times_us for k, run in runs if k == kind]) for kind in set(KINDS)}
        for kind, what in (
            (FREE, "ppoll, read and write in compiled code"),
            (STEP, "and decode, plausibility, step, encode; no output guard, gate, recorder"),
            (BESIDE, "the same beside a Python thread of the process that spins"),
        ):
            for name, share, factor in GOALS:
                ours, bare = (float(np.percentile(times[k], share)) for k in (kind, BARE))
                must = kind == STEP
                yield Row(
                    f"one compiled thread, {where}, {kind}, {name}", what, ours, bare, "bare echo, same carrier", "us",
                    ours / bare, f"<= {factor:g} x" if must else "-", ours <= factor * bare if must else None,
                    must=must, why="only parts of the firmware are in it" if must else "",
                )  # fmt: skip
        ours, alone = (float(np.median(times[k])) for k in (BESIDE, STEP))
        yield Row(
            f"one compiled thread, {where}, beside a spinning thread, p50", "the GIL is never taken", ours, alone,
            "the same alone", "us", ours / alone, f"<= {BESIDE_GOAL:g} x", ours <= BESIDE_GOAL * alone, must=True,
            why="both share two processors with the world",
        )  # fmt: skip
        late, bare_late = (100.0 * float(np.mean(times[k] >= PERIOD_NS * 1e-3)) for k in (STEP, BARE))
        yield Row(
            f"one compiled thread, {where}, later than a period", "answers that took a period or more", late, bare_late,
            "bare echo", "%", late / max(bare_late, 100.0 / TICKS), "<= 2 x",
            late <= 2.0 * max(bare_late, 100.0 / TICKS), must=True, why="the machine took the processor away",
        )  # fmt: skip
        core = next(run.core for kind, run in runs if kind == STEP)
        yield Row(f"one compiled thread, {where}, CPU", "share of a core at 1 kHz", core, 1.0, "one core",
                  "cores", core, "<= 0.15", core <= 0.15, must=True)  # fmt: skip
    yield from run_rows()


class Run(NamedTuple):
    """Holds the firmware's own figures of a run, and the ``core`` share of its process from opening to end."""

    outcome: dict[str, Any]
    core: float

    def latency_us(self, share: str) -> float:
        return self.outcome["latency"]["sample_to_command_us"][share]

    @property
    def without_command(self) -> float:
        """Share of scans, in %, that did not get a tick of their own: skipped, or caught up with in a later tick."""
        ticks = self.outcome["ticks"]
        without = ticks["caught_up"] + ticks["skipped"]
        return 100.0 * without / max(ticks["run"] + without, 1)


def run(beside: str) -> None:
    """Be the firmware of ``micron run --compiled`` on the serial bench, and print its ``Run`` as JSON."""
    bench = bench_path(None).with_name(SERIAL)
    run_in_process(RunRequest(bench, 0.5, pace="realtime", compiled=True))  # everything is compiled or loaded
    with tempfile.TemporaryDirectory(prefix="micron-") as folder:
        record = Path(folder) / "run.mcap" if beside == RECORDING else None
        if beside == SPINNING:
            threading.Thread(target=_spin, daemon=True).start()
        cpu_s, wall_s = time.process_time(), time.monotonic()
        outcome, _ = run_in_process(
            RunRequest(bench, RUN_S, pace="realtime", compiled=True, record=record), own_process=True
        )
        core = (time.process_time() - cpu_s) / (time.monotonic() - wall_s)
    print(json.dumps([{key: outcome[key] for key in ("latency", "ticks", "loop", "safe_state")}, core]), flush=True)
    os._exit(0)


def run_beside(beside: str) -> Run:
    command = [sys.executable, "-m", "benchmarks.wire", "run", beside]
    done = subprocess.run(command, capture_output=True, text=True, check=True)
    return Run(*json.loads(done.stdout.splitlines()[-1]))


def run_rows() -> Iterator[Row]:
    """``micron run --compiled`` itself, scan instant to the command's bytes in the pty, with everything in it."""
    before = echo_us()
    runs = {beside: run_beside(beside) for beside in (ALONE, SPINNING, RECORDING)}
    echo = np.concatenate([before, echo_us()])
    for beside, found in runs.items():
        compiled, ticks = found.outcome["loop"]["ticks"], found.outcome["ticks"]["run"]
        reason = found.outcome["safe_state"]["reason"]
        for name, share, factor in GOALS:
            ours, bare = found.latency_us(name.replace(".", "_")), float(np.percentile(echo, share))
            must = beside == ALONE
            yield Row(
                f"run --compiled, pty, {beside}, {name}", f"{compiled} of {ticks} ticks were compiled; end: {reason}",
                ours, bare, "bare echo, pty, same policy", "us", ours / bare, f"<= {factor:g} x" if must else "-",
                ours <= factor * bare if must else None, must=must, why="the host's stalls are in it" if must else "",
            )  # fmt: skip
    alone = runs[ALONE]
    for beside in (SPINNING, RECORDING):
        ours, peer = runs[beside].latency_us("p50"), alone.latency_us("p50")
        yield Row(
            f"run --compiled, pty, {beside}, p50", "the whole run beside it, page and viewer not", ours, peer,
            "the same alone", "us", ours / peer, f"<= {BESIDE_GOAL:g} x", ours <= BESIDE_GOAL * peer, must=True,
            why="all share two processors with the world",
        )  # fmt: skip
    late = max(100.0 * float(np.mean(echo >= PERIOD_NS * 1e-3)), 100.0 / len(echo))
    yield Row(
        "run --compiled, pty, scans without a command", "skipped or caught up with in a later tick",
        alone.without_command, late, "bare echo later than a period", "%", alone.without_command / late, "<= 2 x",
        alone.without_command <= 2.0 * late, must=True, why="holds and self-test are Python's ticks; the host's stalls",
    )  # fmt: skip
    yield Row(
        "run --compiled, pty, CPU", "the firmware's process from opening to end, self-test in it", alone.core, 1.0,
        "one core", "cores", alone.core, "<= 0.15", alone.core <= 0.15, must=True,
        why="the magnetometer, the supervision and the telemetry beside the thread are Python",
    )  # fmt: skip


if __name__ == "__main__":
    if sys.argv[1] == "run":
        run(sys.argv[2])
    answer(sys.argv[1], int(sys.argv[2]))
