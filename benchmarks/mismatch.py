"""Diagnosis of a recording: a minute at 1 kHz end to end, one candidate, and growth with the length of the record."""

from __future__ import annotations

import os
import time
from collections.abc import Iterator
from pathlib import Path

import numpy as np

from benchmarks.row import Row

RATE_HZ = 1000.0
SECONDS = (15.0, 60.0)
GOAL_S = 30.0


def stack_recording(seconds: float):
    """A piezo stack under a wandering sum of sines: Bouc-Wen hysteresis (not the engine's own form), noise 0.02 um."""
    from tools.mismatch.recording import Recording, Split, TwinText

    n = round(seconds * RATE_HZ)
    t = np.arange(n) / RATE_HZ
    rng = np.random.default_rng(1)
    slow = 1.0 + 0.4 * np.sin(2 * np.pi * 0.11 * t)
    u = 50.0 + slow * (18.0 * np.sin(2 * np.pi * 1.3 * t) + 7.0 * np.sin(2 * np.pi * 8.7 * t + 0.4))
    z = np.zeros(n)
    for k in range(1, n):
        du = u[k] - u[k - 1]
        z[k] = z[k - 1] + 0.4 * du - 0.05 * abs(du) * z[k - 1] - 0.02 * du * abs(z[k - 1])
    y = 0.13 * u + 0.03 * z + 0.02 * rng.standard_normal(n)
    return Recording(
        Path("benchmark.toml"), "benchmark", t, 1.0 / RATE_HZ, {"command": u}, {"displacement": y}, {},
        {"displacement": 0.02}, {"command": "V", "displacement": "um"}, {"command": "u", "displacement": "y"},
        TwinText("piezo_stack", {"gain_um_per_V": 0.125}, ()), Split(),
    )  # fmt: skip


def measure(seconds: float, jobs: int) -> tuple[float, float, int]:
    """(wall s, CPU s of this process, candidates that were screened)."""
    from tools.mismatch.engine.diagnose import diagnose

    recording = stack_recording(seconds)
    wall, cpu = time.perf_counter(), time.process_time()
    report = diagnose(recording, jobs=jobs)
    return time.perf_counter() - wall, time.process_time() - cpu, len(report.tested)


def rows() -> Iterator[Row]:
    measure(4.0, 1)  # kernels compiled or read
    short_s, long_s = (measure(s, 1) for s in SECONDS)
    exponent = float(np.log(long_s[1] / short_s[1]) / np.log(SECONDS[1] / SECONDS[0]))
    cores = min(2, os.cpu_count() or 1)
    wall_s = measure(SECONDS[1], cores)[0] if cores > 1 else long_s[0]
    yield Row(
        "mismatch diagnose, 60 s at 1 kHz", f"wall time with {cores} processes", wall_s, long_s[0], "one process", "s",
        long_s[0] / wall_s, f"<= {GOAL_S:g} s", wall_s <= GOAL_S,
    )  # fmt: skip
    share = long_s[1] / max(long_s[2], 1)
    yield Row(
        "mismatch diagnose, one candidate", "CPU of the whole diagnosis over the places tried first", share, long_s[1],
        "whole diagnosis", "s", share / long_s[1], "-", None,
    )  # fmt: skip
    yield Row(
        "mismatch diagnose, growth with length", "exponent of CPU time, 15 s to 60 s", exponent, 1.0, "linear", "1",
        exponent, "<= 1.2", exponent <= 1.2,
    )  # fmt: skip


if __name__ == "__main__":
    for row in rows():
        print(f"{row.name}: {row.ours:.3g} {row.unit} ({row.peer_name} {row.peer:.3g}), goal {row.goal}: {row.meets}")
