"""What the numeric differential kinematics costs beside the analytic one: the solve alone, and the whole tick."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from benchmarks import step_input
from benchmarks.row import Row, side_by_side
from firmware_py.control.stages import StageConfigs, Stages
from firmware_py.frame import ACCELEROMETER, RATE
from firmware_py.sensing.kinematics import solve_motion
from firmware_py.sensing.numeric_kinematics import solve_numeric
from hal.compiled import kernel

N = 4000
DT_S = 1e-3


@kernel
def analytic_rows(frames, params, out):
    for k in range(len(frames)):
        row = frames[k]
        solve_motion(row[ACCELEROMETER : ACCELEROMETER + 6], row[RATE : RATE + 3], params[0], out)
    return len(frames)


@kernel
def numeric_rows(frames, params, out):
    iterations = 0
    for k in range(len(frames)):
        row = frames[k]
        iterations += solve_numeric(row[ACCELEROMETER : ACCELEROMETER + 6], row[RATE : RATE + 3], DT_S, params[0], out)
    return iterations


def with_method(configs: StageConfigs, method: str) -> Stages:
    sensing = configs.sensing.model_copy(update={"kinematics_method": method})
    return Stages(StageConfigs(sensing, configs.tremor, configs.actuation))


def rows() -> Iterator[Row]:
    ready, inputs = step_input.settled(N)
    configs = ready.configs
    frames = inputs.copy()
    ready.run(frames)
    params, out = np.atleast_1d(ready.sensing.params)["kinematics"], np.empty(6)
    analytic_rows(frames, params, out)
    mean = numeric_rows(frames, params, out) / N
    mine, theirs = side_by_side(
        (lambda: numeric_rows(frames, params, out), lambda: analytic_rows(frames, params, out)), N
    )
    yield Row(
        "kinematics, numeric", f"one solve of six axes in a batch, {mean:.2f} iterations on average", mine, theirs,
        "analytic", "us", mine / theirs,
    )  # fmt: skip
    both = [with_method(configs, method) for method in ("numeric", "analytic")]
    for one in both:
        one.run(inputs[:10].copy())
    mine, theirs = side_by_side([lambda one=one: one.run(inputs.copy()) for one in both], N)
    yield Row(
        "tick, numeric kinematics", "the whole step in a batch", mine, theirs, "analytic", "us", mine / theirs,
    )  # fmt: skip
