"""The 1 kHz loop in real time with recorder, telemetry and a page viewer beside it, against a C loop that does nothing.

Missed: a tick that began a whole period late. The machine takes the processor away from both; what counts is the ratio
within one run, and the percentiles say more than the count.
"""

from __future__ import annotations

import subprocess
import tempfile
from collections.abc import Iterator
from pathlib import Path

import numpy as np

from benchmarks.bench_page import SECONDS, measure
from benchmarks.latency import SERIAL, echo_us
from benchmarks.row import Row
from benchmarks.yardstick import compiler
from tools.cli.bench_option import bench_path

PERIOD_US = 1000.0


def reference_us(seconds: float) -> np.ndarray | None:
    """Lateness of every tick of the C loop, or None without a compiler."""
    found = compiler()
    if found is None:
        return None
    with tempfile.TemporaryDirectory(prefix="micron-") as folder:
        program = str(Path(folder) / "reference_loop")
        source = str(Path(__file__).with_name("reference_loop.c"))
        subprocess.run([found, "-O2", source, "-o", program], check=True)
        run = subprocess.run([program, f"{seconds}"], check=True, capture_output=True, text=True)
    return np.array([float(word) for word in run.stdout.split()])


def rows() -> Iterator[Row]:
    before = reference_us(SECONDS / 2)
    found = measure(bench_path(None))
    serial = measure(bench_path(None).with_name(SERIAL))
    after = reference_us(SECONDS / 2)
    echo = echo_us()
    share = found["core"]
    yield Row(
        "bench page, server",
        f"share of a core: 20 channels at 1 kHz, one viewer that got {found['frames_per_s']:.1f} frames a second",
        share, 1.0, "one core", "cores", share, "<= 0.10", share <= 0.10,
    )  # fmt: skip
    ratio = found["watched_us"] / found["alone_us"]
    yield Row(
        "bench page, tick p99", "firmware's tick with a viewer, against the same run without", found["watched_us"],
        found["alone_us"], "no viewer", "us", ratio, "<= 1.2 x", ratio <= 1.2,
    )  # fmt: skip
    if before is None or after is None:
        yield Row("loop, missed ticks", "no C compiler", found["missed"], np.nan, "C loop", "%", np.nan,
                  "<= 1.5 x", None, must=True, why="no compiler")  # fmt: skip
        return
    late = np.concatenate([before, after])
    missed = 100.0 * float(np.mean(late >= PERIOD_US))
    p99, p999 = np.percentile(late, [99, 99.9])
    yield Row(
        "bare echo on a pty, later than a period", "the same machine with a port: two wake-ups and the kernel's worker",
        100.0 * float(np.mean(echo >= PERIOD_US)), missed, "C loop", "%",
        100.0 * float(np.mean(echo >= PERIOD_US)) / max(missed, 1e-3),
    )  # fmt: skip
    for where, run, why in (
        ("I2C", found, "the emulated bus at 400 kHz fills the ticks: 24 transfers of 0.1 to 0.4 ms in ten of them"),
        (
            "serial",
            serial,
            "no one cause found: reads of the magnetometer (0.3 ms, three in ten ticks), halted cores that come back "
            "late on a quiet virtual machine, a pty's kernel worker on a busy one (see the echo); the C loop spins",
        ),
    ):
        mine = run["missed"]
        yield Row(
            f"loop, missed ticks, {where}",
            f"recorder, telemetry, viewer on; lateness p99 {run['late_p99_us']:.0f} (C {p99:.0f}), "
            f"p99.9 {run['late_p999_us']:.0f} (C {p999:.0f}) us",
            mine, missed, "C loop", "%", mine / max(missed, 1e-3), "<= 1.5 x", mine <= 1.5 * max(missed, 0.01),
            must=True, why=why,
        )  # fmt: skip
