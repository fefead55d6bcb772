"""(a) The step: sense, detect, estimate, actuate; against the C yardstick, against plain numpy, and by stage."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator

import numpy as np
from numpy.typing import NDArray

from benchmarks import step_input
from benchmarks.numpy_step import NumpyStep
from benchmarks.row import Row, side_by_side
from benchmarks.yardstick import STAGES, Yardstick, compiler
from firmware_py.control.chain import actuate_kernel, detect_kernel, estimate_kernel, sense_kernel
from firmware_py.control.stages import Stages
from firmware_py.frame import LAYOUT, STATUS, TICK, VOLTS
from hal.compiled import kernel

N = 4000
NUMPY_TICKS = 400
COLD_TICKS = 400
COLD_BYTES = 32 << 20
PERIOD_US = 1000.0
Rows = NDArray[np.float64]


@kernel
def sense_rows(rows, state, params):
    for k in range(len(rows)):
        sense_kernel(rows[k], state, params)


@kernel
def estimate_rows(rows, state, params):
    for k in range(len(rows)):
        estimate_kernel(rows[k], state, params)


@kernel
def detect_rows(rows, state, params):
    for k in range(len(rows)):
        detect_kernel(rows[k], state, params)


@kernel
def actuate_rows(rows, state, params):
    for k in range(len(rows)):
        actuate_kernel(rows[k], state, params)


LOOPS = (sense_rows, estimate_rows, detect_rows, actuate_rows)


class Again:
    """Stages that can be put back to where they were: each repeat does the same work."""

    def __init__(self, n: int) -> None:
        self.stages, self.rows = step_input.settled(n)
        self._kept = [record.copy() for record in self.stages.arguments]
        self._frame = self.stages.frame.copy()
        self.work = self.rows.copy()

    def back(self, rows: Rows | None = None) -> Stages:
        for record, kept in zip(self.stages.arguments, self._kept, strict=True):
            record[:] = kept
        self.stages.frame[:] = self._frame
        self.work[:] = self.rows if rows is None else rows
        return self.stages


def nothing() -> None:
    """Before a tick whose predecessor has just run: what it needs is in the caches."""


def feed(stages: Stages, rows: Rows, step: Callable[[], object], before: Callable[[], object] = nothing) -> Rows:
    """Every tick by itself, inputs copied as the loop does; finished frames back in ``rows``; thread CPU us each."""
    frame = stages.frame
    times = np.empty(len(rows))
    for k, row in enumerate(rows):
        frame[:VOLTS] = row[:VOLTS]
        frame[STATUS] = row[STATUS]
        before()
        started_ns = time.thread_time_ns()
        step()
        times[k] = time.thread_time_ns() - started_ns
        row[:] = frame
    return times * 1e-3


def clock_us() -> float:
    """What asking for the time costs, to be taken off single calls."""
    times = [-(time.thread_time_ns() - time.thread_time_ns()) for _ in range(2000)]
    return float(np.median(times)) * 1e-3


def same(found: Rows, wanted: Rows, what: str, bound: float = 1e-6) -> None:
    """A peer that computes something else is not a peer."""
    for column in LAYOUT:
        a, b = found[:, column.span], wanted[:, column.span]
        size = max(float(np.abs(b).max()), 1e-9)
        if not float(np.abs(a - b).max()) <= bound * size:
            raise AssertionError(f"{what}: column {column.name} differs by {np.abs(a - b).max():g} of {size:g}")


def cold(ours: Again, peer: Again, c: Yardstick) -> Row:
    """A tick as in the live loop, where a millisecond of other work lies between two."""
    others = np.zeros(COLD_BYTES // 8)

    def other_work() -> None:
        others[:] += 1.0

    found = []
    for again, step in ((ours, ours.stages.step), (peer, c.step)):
        again.back()
        found.append(np.percentile(feed(again.stages, again.work[:COLD_TICKS], step, other_work), [50, 99]))
    (p50, p99), (c_p50, c_p99) = found
    return Row(
        "tick, caches cold",
        f"p50 of one call after {COLD_BYTES >> 20} MB went through the caches: the live loop's case at its worst; "
        f"p99 {p99:.0f} against {c_p99:.0f} us",
        p50, c_p50, "C, -O3", "us", p50 / c_p50, "<= 2 x", p50 <= 2.0 * c_p50, must=True,
    )  # fmt: skip


def rows() -> Iterator[Row]:
    ours = Again(N)
    ours.back().run(ours.work)
    finished = ours.work.copy()
    single = feed(ours.back(), ours.work, ours.stages.step) - clock_us()
    same(ours.work, finished, "single calls", 0.0)
    p50, p99, p999 = np.percentile(single, [50, 99, 99.9])
    yield Row(
        "tick, p99 of the step", f"thread CPU of one call from Python; p50 {p50:.1f}, p99.9 {p999:.1f} us", p99,
        PERIOD_US, "the period", "us", p99 / PERIOD_US, "< 0.10", p99 < 0.1 * PERIOD_US, must=True,
    )  # fmt: skip

    plain = Again(NUMPY_TICKS)
    numpy_step = NumpyStep(plain.back())
    numpy_us = feed(plain.stages, plain.work, numpy_step.step)
    same(plain.work, finished[:NUMPY_TICKS], "numpy")
    slow = float(np.median(numpy_us))
    yield Row(
        "tick, against plain numpy", "p50 of one call; the numpy version gives the same numbers", p50, slow, "numpy",
        "us", slow / p50, ">= 20 x", slow >= 20.0 * p50, must=True,
    )  # fmt: skip

    if compiler() is None:
        yield Row("tick, against C", "no C compiler on this machine: cc, gcc or clang", p50, np.nan, "C", "us", np.nan,
                  "<= 2 x", None, must=True, why="no compiler")  # fmt: skip
        return
    peer = Again(N)
    c = Yardstick(peer.back())
    done = c.run(peer.work)
    if done != N:
        raise AssertionError(f"the C version left the regular way at row {done}")
    same(peer.work, finished, "C", 1e-7)
    c_single = feed(peer.back(), peer.work, c.step) - clock_us()
    c_p50, c_p99 = np.percentile(c_single, [50, 99])
    yield Row(
        "tick, one call from Python", f"p50; the C version through ctypes; p99 {p99:.1f} against {c_p99:.1f} us", p50,
        c_p50, "C, -O3", "us", p50 / c_p50, "<= 2 x", p50 <= 2.0 * c_p50, must=True,
    )  # fmt: skip

    yield cold(ours, peer, c)

    def batch() -> None:
        ours.back().run(ours.work)

    def c_batch() -> None:
        peer.back()
        c.run(peer.work)

    def put_back() -> None:
        ours.back()

    mine, theirs, overhead = side_by_side((batch, c_batch, put_back), N)
    mine, theirs = mine - overhead, theirs - overhead
    yield Row(
        "tick, in a batch", "inside compiled code, as replay does it", mine, theirs, "C, -O3", "us", mine / theirs,
        "<= 2 x", mine <= 2.0 * theirs, must=True,
    )  # fmt: skip
    frames = finished.copy()
    frames[:, TICK] = ours.rows[:, TICK]
    for i, name in enumerate(STAGES):
        loop, state, params = LOOPS[i], *ours.stages.arguments[2 * i : 2 * i + 2]
        loop(frames[:1].copy(), state, params)

        def stage(loop=loop, state=state, params=params) -> None:
            ours.back(frames)
            loop(ours.work, state, params)

        def c_stage(name=name) -> None:
            peer.back(frames)
            c.run_stage(name, peer.work)

        mine, theirs, overhead = side_by_side((stage, c_stage, put_back), N)
        mine, theirs = mine - overhead, theirs - overhead
        yield Row(f"tick, {name}", "this stage alone, in a batch", mine, theirs, "C, -O3", "us", mine / theirs)
