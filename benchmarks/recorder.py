"""(i) What the recorder costs the loop: CPU of one push, and the longest one, also while the writer stalls."""

from __future__ import annotations

import os
import signal
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path

import numpy as np

from benchmarks.row import Row
from firmware_py.frame import LAYOUT
from firmware_py.recording.recorder import RecorderProcess

TICKS = 4000
STALL_AT, STALL_TICKS = 1500, 1000


def rows() -> Iterator[Row]:
    columns = list(zip(LAYOUT.scalar_names(), LAYOUT.scalar_units(), strict=True))
    frame = np.random.default_rng(1).standard_normal(LAYOUT.size)
    cpu, wall = np.empty(TICKS), np.empty(TICKS)
    with tempfile.TemporaryDirectory(prefix="micron-") as folder:
        recorder = RecorderProcess.start(Path(folder) / "run.mcap", columns, {"clock": "real"}, lossless=False)
        pid = recorder._process.pid
        for k in range(TICKS):
            frame[0] = k
            if k == STALL_AT:
                os.kill(pid, signal.SIGSTOP)  # a disk that does not answer
            elif k == STALL_AT + STALL_TICKS:
                os.kill(pid, signal.SIGCONT)
            wall_ns, cpu_ns = time.monotonic_ns(), time.thread_time_ns()
            recorder.push(frame)
            cpu[k], wall[k] = time.thread_time_ns() - cpu_ns, time.monotonic_ns() - wall_ns
            time.sleep(0.0005)
        summary = recorder.stop()
    cpu *= 1e-3
    p50, p99 = np.percentile(cpu, [50, 99])
    what = (
        f"{LAYOUT.size} columns; p99 {p99:.1f} us; writer stopped for {STALL_TICKS} ticks, {summary.dropped} rows lost"
    )
    yield Row("recorder, cost per tick", what, p50, 1000.0, "the period", "us", p50 / 1000.0, "-", None)
    longest = float(cpu.max())
    yield Row(
        "recorder, longest stall", f"thread CPU of the longest push; wall {wall.max() * 1e-3:.0f} us",
        longest, 1000.0, "the period", "us", longest / 1000.0, "< 1", longest < 1000.0,
    )  # fmt: skip
