"""(g) Diagnosis of a recording: a minute at 1 kHz end to end, one candidate, growth with length, jobs, and what pysindy
and SysIdentPy do with the same recording: they fit one model, name no physics and hold nothing out by themselves."""

from __future__ import annotations

import os
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.row import Row, exponent, process_cpu_s

RATE_HZ = 1000.0
SECONDS = (15.0, 60.0, 240.0)
LONG_S = 1800.0
"""Only with ``MICRON_BENCH_LONG=1`` (make bench LONG=1): about eight minutes of CPU by itself."""
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


def peers(recording: Any) -> Iterator[Row]:
    """The nearest general tools: one call of the kind that their documents show, on the recording's first minute."""
    import pysindy
    from sysidentpy.basis_function import Polynomial
    from sysidentpy.model_structure_selection import AOLS

    u, y = recording.inputs["command"][:, None], recording.outputs["displacement"][:, None]

    def sindy() -> None:
        # displacement and a memory of it as states, driven by the command
        model = pysindy.SINDy(optimizer=pysindy.STLSQ(threshold=1e-4), feature_library=pysindy.PolynomialLibrary(2))
        model.fit(y, t=1.0 / RATE_HZ, u=u)

    def narx() -> None:
        # FROLS, which chooses the number of terms itself, fails with numpy 2.4 (SysIdentPy 0.2.1)
        AOLS(ylag=2, xlag=2, k=8, L=1, basis_function=Polynomial(degree=2)).fit(X=u, y=y)

    yield from (
        Row(f"mismatch, {name}", "one fit of one model: no candidates, no names, nothing held out", np.nan,
            process_cpu_s(function), name, "s", np.nan)
        for name, function in (("pysindy", sindy), ("SysIdentPy, AOLS", narx))
    )  # fmt: skip


def rows() -> Iterator[Row]:
    measure(4.0, 1)  # kernels compiled or read
    lengths = (*SECONDS, LONG_S) if os.environ.get("MICRON_BENCH_LONG") == "1" else SECONDS
    short_s, minute_s = lengths[:2]
    costs = [measure(short_s, 1)[1]]
    alone_s, cpu_s, screened = measure(minute_s, 1)
    costs.append(cpu_s)
    cores = min(2, os.cpu_count() or 1)
    wall_s = measure(minute_s, cores)[0] if cores > 1 else alone_s
    reached = wall_s <= GOAL_S
    yield Row(
        f"mismatch, {minute_s:g} s at 1 kHz", f"all candidates, wall time with {cores} processes",
        wall_s, GOAL_S, "allowed", "s", wall_s / GOAL_S, f"<= {GOAL_S:g} s", reached, must=True,
        why="" if reached else f"wall time on a shared machine: {cpu_s:.1f} s of CPU with one process",
    )  # fmt: skip
    yield Row(
        "mismatch, more processes", f"wall time with {cores} against 1; CPU of the one {cpu_s:.1f} s", wall_s, alone_s,
        "one process", "s", alone_s / wall_s,
    )  # fmt: skip
    share_s = cpu_s / max(screened, 1)
    yield Row(
        "mismatch, one candidate", f"CPU of the whole diagnosis over the {screened} effects at places that it tried",
        share_s, cpu_s, "whole diagnosis", "s", share_s / cpu_s,
    )  # fmt: skip
    costs += [measure(seconds, 1)[1] for seconds in lengths[2:]]
    grows = exponent(lengths, costs)
    each = ", ".join(f"{seconds:g} s: {cost:.1f}" for seconds, cost in zip(lengths, costs, strict=True))
    yield Row(
        "mismatch, growth with length", f"exponent of CPU; s of CPU for {each}", grows, 1.0, "linear", "1", grows,
        "<= 1.2", grows <= 1.2, must=True,
    )  # fmt: skip
    yield from peers(stack_recording(minute_s))
