"""(l) ``micron run --realtime``, compiled and in Python, beside a bare loop on the same wires, in one run.

Serial bench: scans come and commands go over a pty each. Default bench: scans over a pty, commands over the socket of
the emulated I2C bus, whose own time is taken off. The bare loop (``benchmarks.bare``) answers scans of the same
emulated world with nothing in between. "Over a socket pair" is the serial bench with its ptys replaced
(``socket_line``); "beside the page" is a compiled run that the bench page has started, records and shows to a viewer
(``wire_page``).

``python -m benchmarks.wire only page socket [SECONDS]`` prints the rows of these two alone, with runs of SECONDS each.
"""

from __future__ import annotations

import json
import os
import re
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from benchmarks import socket_line
from benchmarks.bare import Bare
from benchmarks.machine import stolen_ms
from benchmarks.row import Row
from benchmarks.wire_page import run_watched
from drivers.piezo.dac_amplifier import WIRE_BITS
from firmware_py.app import run_in_process
from firmware_py.run_request import RunRequest
from hal.bench import OpenBench
from tools.cli.bench_option import bench_path

I2C_HZ = 400_000
BUS_NS = round(WIRE_BITS["command"] * 1e9 / I2C_HZ)
COMPILED, PYTHON, SPINNING = "compiled", "Python", "compiled beside a thread that spins"
WATCHED = "compiled beside the page"
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
    time in ns of the emulated bus that a command has to wait for. ``has_sockets``: socket pairs replace its ptys."""

    name: str
    file: str
    tick_hz: int
    kinds: tuple[str, ...]
    run_s: float
    bus_ns: int
    has_sockets: bool = False

    @property
    def period_us(self) -> float:
        return 1e6 / self.tick_hz


SETUPS = (
    Setup("serial", "micron-e727.toml", 1000, (COMPILED, PYTHON, SPINNING, WATCHED), 12.0, 0),
    Setup("I2C", "micron.toml", 1000, (COMPILED, PYTHON, SPINNING, WATCHED), 8.0, BUS_NS),
    Setup("serial at 4 kHz", "micron-e727.toml", FAST_HZ, (COMPILED, PYTHON), 5.0, 0),
    Setup("serial over a socket pair", "micron-e727.toml", 1000, (COMPILED, PYTHON), 12.0, 0, has_sockets=True),
)
ONLY: dict[str, tuple[Setup, ...]] = {
    "page": tuple(each._replace(kinds=(COMPILED, WATCHED)) for each in SETUPS[:2]),
    "socket": SETUPS[3:],
}
"""Parts of the rows that can be measured alone."""


class Run(NamedTuple):
    """Holds the firmware's own figures of a run, the ``core`` share of its process since the bench was open, the part
    of it of its main thread, which also sets up, arms and runs the compiled loop, and the time in ms that the host took
    from the machine."""

    outcome: dict[str, Any]
    core: float
    main_core: float
    stolen_ms: float
    frames_per_s: float = 0.0
    """Frames that a viewer of the page got."""

    def latency_us(self, name: str) -> float:
        return self.outcome["latency"]["sample_to_command_us"][name.replace(".", "_")]

    @property
    def without_command(self) -> float:
        """Share of scans, in %, that did not get a tick of their own: skipped, or caught up with in a later tick.
        Of a compiled run the scans since its thread was entered first count that came while the outputs could move: in
        a hold nothing is commanded, and the bare loop has none. Of a run in Python all scans count but the ones that
        came while the outputs were being armed."""
        ticks, loop = self.outcome["ticks"], self.outcome.get("loop", {})
        if "passed_over" in loop:
            return 100.0 * loop["passed_over"] / max(loop["ticks"] + loop["passed_over"], 1)
        arming = sum(one["caught_up"] + one["skipped_ticks"] for one in ticks["announced"].values())
        without = ticks["caught_up"] + ticks["skipped"] - arming
        return 100.0 * without / max(ticks["run"] + without, 1)

    @property
    def what(self) -> str:
        compiled, ticks = self.outcome.get("loop", {}).get("ticks", 0), self.outcome["ticks"]["run"]
        held, safe = len(self.outcome["holds"]), self.outcome["safe_state"]
        ended = "" if safe["normal"] else f"; ended early: {safe['reason']}"
        sent = self.outcome["commands"]["sent"]
        loop = self.outcome.get("loop", {})
        holds = f"{held} holds"
        if "passed_over" in loop:
            busy, idle = loop["passed_over_busy"], loop["passed_over_held"]
            holds = f"{loop['passed_over']} scans passed over ({busy} at work), {holds} with {idle} more"
        return f"{sent} commands, {compiled} of {ticks} ticks compiled, {holds}, {self.host}{ended}"

    @property
    def host(self) -> str:
        """Say what host and kernel did meanwhile: "steal" of /proc/stat, the time for which the thread was ready and
        did not run, and the world's pauses."""
        stalls, longest_ms = self.outcome["host"]["stalls"], self.outcome["host"]["longest_stall_ms"]
        waited_ms = self.outcome.get("loop", {}).get("kept_waiting_ms")
        kernel = "" if waited_ms is None else f", kernel {waited_ms:.1f} ms"
        return f"host took {self.stolen_ms:g} ms{kernel}, {stalls} pauses of the world (longest {longest_ms:.1f} ms)"


# -- the bare loop -----------------------------------------------------------------------------------------


def measure_bare(setup: Setup, *, polls: bool = False) -> Bare:
    """Run the bare loop of ``benchmarks.bare`` on the bench of ``setup``, in a process of its own. The emulated bus is
    taken off."""
    with tempfile.TemporaryDirectory(prefix="micron-") as folder:
        file = bench_file(setup, Path(folder))
        command = [sys.executable, "-m", "benchmarks.bare", str(file), f"{setup.run_s:g}", f"{setup.tick_hz}"]
        words = ["polls"] * polls + ["sockets"] * setup.has_sockets
        done = subprocess.run([*command, *words], capture_output=True, text=True, check=False)
    if done.returncode:
        raise RuntimeError(f"bare loop, {setup.name}: {(done.stderr.strip().splitlines() or ['no reason'])[-1]}")
    bare = Bare(*json.loads(done.stdout))
    return bare._replace(late_us=[late_us - setup.bus_ns * 1e-3 for late_us in bare.late_us])


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
    found: list[tuple[dict[str, Any], float, float, float]] = []
    if setup.has_sockets:
        socket_line.install()
    with tempfile.TemporaryDirectory(prefix="micron-") as folder:
        bench = bench_file(setup, Path(folder))
        for compiled in (True, False):  # everything is compiled or loaded
            run_in_process(RunRequest(bench, 0.05, pace="realtime", compiled=compiled))
        for kind in own_kinds(setup):
            if kind == SPINNING:
                threading.Thread(target=_spin, daemon=True).start()
            began: list[float] = []

            def on_open(opened: OpenBench, began: list[float] = began) -> None:
                began[:] = time.process_time(), time.monotonic(), time.thread_time(), stolen_ms()

            request = RunRequest(bench, setup.run_s, pace="realtime", compiled=kind != PYTHON)
            outcome, _ = run_in_process(request, on_open=on_open)
            took_s = time.monotonic() - began[1]
            core, main_core = (time.process_time() - began[0]) / took_s, (time.thread_time() - began[2]) / took_s
            found.append((figures_of(outcome), core, main_core, stolen_ms() - began[3]))
    print(json.dumps(found, default=str), flush=True)
    os._exit(0)


def own_kinds(setup: Setup) -> list[str]:
    """Return the kinds of run that are made in one process of firmware."""
    return [kind for kind in setup.kinds if kind != WATCHED]


def figures_of(outcome: dict[str, Any]) -> dict[str, Any]:
    """Return the part of an outcome that the rows are made of."""
    kept = ("latency", "ticks", "loop", "safe_state", "holds", "commands", "host")
    return {key: outcome[key] for key in kept if key in outcome}


def measure_runs(setup: Setup) -> dict[str, Run]:
    """Return the run of each kind of ``setup``, made in a process of its own."""
    command = [sys.executable, "-m", "benchmarks.wire", "run", json.dumps(setup)]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    if done.returncode:
        raise RuntimeError(f"{setup.name}: {(done.stderr.strip().splitlines() or ['no reason'])[-1]}")
    made = [Run(*each) for each in json.loads(done.stdout.splitlines()[-1])]
    runs = dict(zip(own_kinds(setup), made, strict=True))
    if WATCHED in setup.kinds:
        runs[WATCHED] = measure_watched(setup)
    return runs


def measure_watched(setup: Setup) -> Run:
    """Return a compiled run that the page has started, records and shows to one viewer. Only its own ``cpu_share`` is
    known of its processor time."""
    with tempfile.TemporaryDirectory(prefix="micron-") as folder:
        before_ms = stolen_ms()
        outcome, frames_per_s = run_watched(bench_file(setup, Path(folder)), setup.run_s, Path(folder))
    core = float(outcome["host"]["cpu_share"] or 0.0)
    return Run(figures_of(outcome), core, float("nan"), stolen_ms() - before_ms, frames_per_s)


# -- rows --------------------------------------------------------------------------------------------------


def rows(setups: Sequence[Setup] = SETUPS) -> Iterator[Row]:
    for setup in setups:
        before = measure_bare(setup)
        runs = measure_runs(setup)
        after = measure_bare(setup)
        bare = Bare(
            before.late_us + after.late_us, (before.without_command + after.without_command) / 2,
            before.stolen_ms + after.stolen_ms, before.kept_waiting_ms + after.kept_waiting_ms,
            before.pauses + after.pauses, max(before.longest_pause_ms, after.longest_pause_ms),
        )  # fmt: skip
        for kind, run in runs.items():
            if setup.tick_hz == 1000:
                yield from latency_rows(setup, kind, run, bare)
            yield missed_row(setup, kind, run, bare)
        if setup.bus_ns and PYTHON in runs:
            yield from polled_rows(setup, measure_bare(setup, polls=True), bare)
        if SPINNING in runs:
            yield from beside_rows(setup, runs)
        if WATCHED in runs:
            yield from watched_rows(setup, runs)
        if PYTHON in runs:
            yield from core_rows(setup, runs)


def polled_rows(setup: Setup, polled: Bare, bare: Bare) -> Iterator[Row]:
    """Yield how late the emulated world, one process in Python, is because it serves the slow converters, too."""
    for name, share, _ in GOALS:
        ours, peer = (float(np.percentile(each.late_us, share)) for each in (polled, bare))
        yield Row(
            f"sample to command, {setup.name}, bare loop beside the slow converters, {name}",
            f"a Python thread polls them; {polled.host}", ours, peer, "bare loop, same wires", "us",
            ours / peer,
        )  # fmt: skip


def latency_rows(setup: Setup, kind: str, run: Run, bare: Bare) -> Iterator[Row]:
    for name, share, factor in GOALS:
        ours, peer = run.latency_us(name) - setup.bus_ns * 1e-3, float(np.percentile(bare.late_us, share))
        must = kind == COMPILED and not setup.has_sockets
        yield Row(
            f"sample to command, {setup.name}, {kind}, {name}", run.what, ours, peer, "bare loop, same wires", "us",
            ours / peer, f"<= {factor:g} x" if must else "-", ours <= factor * peer if must else None, must=must,
            why=f"{run.host}; bare loop: {bare.host}" if must else "",
        )  # fmt: skip


def missed_row(setup: Setup, kind: str, run: Run, bare: Bare) -> Row:
    late = max(bare.without_command, 100.0 / (2.0 * setup.run_s * setup.tick_hz))  # one scan at least
    factor = 2.0 if setup.tick_hz == 1000 else 1.0
    must = kind == COMPILED and not setup.has_sockets
    return Row(
        f"ticks without a command, {setup.name}, {kind}", f"skipped or caught up with in a later tick; {run.what}",
        run.without_command, late, "the same of the bare loop", "%", run.without_command / late,
        f"<= {factor:g} x" if must else "-", run.without_command <= factor * late if must else None, must=must,
        why=f"{run.host}; bare loop: {bare.host}" if must else "",
    )  # fmt: skip


def beside_rows(setup: Setup, runs: dict[str, Run]) -> Iterator[Row]:
    for name, _, _ in GOALS[:2]:
        ours, peer = (runs[kind].latency_us(name) - setup.bus_ns * 1e-3 for kind in (SPINNING, COMPILED))
        yield Row(
            f"sample to command, {setup.name}, beside a thread that spins, {name}", "the GIL is never waited for",
            ours, peer, "the same alone", "us", ours / peer, f"<= {BESIDE_GOAL:g} x", ours <= BESIDE_GOAL * peer,
            must=True, why="both share two processors with the world",
        )  # fmt: skip


def watched_rows(setup: Setup, runs: dict[str, Run]) -> Iterator[Row]:
    run = runs[WATCHED]
    what = f"the page records and shows 20 channels to one viewer, which got {run.frames_per_s:.0f} frames a second"
    for name, _, _ in GOALS[:2]:
        ours, peer = (runs[kind].latency_us(name) - setup.bus_ns * 1e-3 for kind in (WATCHED, COMPILED))
        yield Row(
            f"sample to command, {setup.name}, beside page, recorder and viewer, {name}", what, ours, peer,
            "the same alone", "us", ours / peer,
        )  # fmt: skip
    ours, peer = (runs[kind].outcome["host"]["cpu_share"] for kind in (WATCHED, COMPILED))
    yield Row(
        f"CPU of the firmware's loop, {setup.name}, beside page, recorder and viewer", what, ours, peer,
        "the same alone", "cores", ours / peer,
    )  # fmt: skip


def core_rows(setup: Setup, runs: dict[str, Run]) -> Iterator[Row]:
    ours, peer = runs[COMPILED].core, runs[PYTHON].core
    must = setup.tick_hz == 1000 and not setup.has_sockets
    yield Row(
        f"CPU of the firmware's process, {setup.name}, compiled", "self-test in it; recorder and world are others'",
        ours, peer, "Python", "cores", ours / peer, f"<= {CORE_GOAL:g} cores" if must else "-",
        ours <= CORE_GOAL if must else None, must=must, why="what runs beside the thread is Python" if must else "",
    )  # fmt: skip
    main = runs[COMPILED].main_core
    yield Row(
        f"CPU of the main thread, {setup.name}, compiled", "compiled loop, arming and self-test; the rest is Python",
        main, ours, "its process", "cores", main / ours,
    )  # fmt: skip


def print_only(words: Sequence[str]) -> None:
    """Print the rows of parts of ``ONLY``; a number behind their names is the length of each run in s."""
    parts = [word for word in words if word in ONLY]
    run_s = [float(word) for word in words if word not in ONLY]
    for part in parts:
        for row in rows([each._replace(run_s=(run_s or [each.run_s])[0]) for each in ONLY[part]]):
            peer = f"{row.peer_name} {row.peer:.3g}, ratio {row.ratio:.3g}"
            print(f"{row.name}: {row.ours:.3g} {row.unit}, {peer}; {row.what}", flush=True)


ROLES: dict[str, Callable[[Sequence[str]], None]] = {
    "run": lambda words: run_all(Setup(*json.loads(words[0]))),
    "only": print_only,
}

if __name__ == "__main__":
    ROLES[sys.argv[1]](sys.argv[2:])
