"""What every benchmark of the step runs on: scans of the emulated instrument in a trembling hand, in closed loop."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import numpy as np
from numpy.typing import NDArray

from firmware_py.control.plan import load_plan
from firmware_py.control.stages import Stages
from firmware_py.frame import COUNTS, LAYOUT, MAGNETOMETER_FRESH, MAGNETOMETER_RAW, STATUS, TICK, TIME, FrameStatus
from hal.bench import load_bench
from tools.cli.bench_option import bench_path

SETTLED = 3000
"""Ticks before the measured ones: aligned, settled, the adaptive filter has begun to solve."""
_OLD_STROKES = {"centring": 0.0, "overdrive_tilts": False, "yield_attack_s": 0.0}


@cache
def _configs():
    """Without what the numpy and C versions lack: relative errors, centring, scales that follow a swing."""
    configs = load_plan(load_bench(bench_path(None))).stages
    adaptive = configs.tremor.adaptive.model_copy(update={"relative": 0.0})
    return replace(
        configs,
        tremor=configs.tremor.model_copy(update={"adaptive": adaptive}),
        actuation=configs.actuation.model_copy(update={**_OLD_STROKES, "overdrive_tilt": configs.actuation.overdrive}),
    )


def stages() -> Stages:
    """The default bench's firmware, before its first sample."""
    return Stages(_configs())


def scans(n: int) -> NDArray[np.float64]:
    """(n, Layout.size): a trembling, slowly turning instrument, as counts; commanded from tick 1000 on.

    A tremor of 0.12 mm at its peak: the strokes stay where nothing has to yield, which the peers leave out.
    """
    rows = np.zeros((n, LAYOUT.size))
    t = np.arange(n) / 1000.0
    rng = np.random.default_rng(1)
    level = np.array([12400, 11600, 17300, 11200, 12000, 17100, 16270, 4747])
    wave = 40.0 * np.sin(2 * np.pi * 10.0 * t)[:, None] * np.array([1, -1, 0.5, 1, 2, -2, 0, 0])
    rows[:, COUNTS : COUNTS + 8] = np.round(level + wave + 3.0 * rng.standard_normal((n, 8)))
    rows[:, TICK] = np.arange(n)
    rows[:, TIME] = t
    rows[::10, MAGNETOMETER_FRESH] = 1.0
    rows[:, MAGNETOMETER_RAW : MAGNETOMETER_RAW + 3] = (2.62, 2.39, 2.93)
    rows[1000:, STATUS] = FrameStatus.COMMANDED
    return rows


def settled(n: int) -> tuple[Stages, NDArray[np.float64]]:
    """Stages that have seen ``SETTLED`` ticks, and the next ``n`` rows of inputs."""
    ready = stages()
    rows = scans(SETTLED + n)
    ready.run(rows[:SETTLED])
    return ready, rows[SETTLED:].copy()
