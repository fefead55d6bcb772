"""Recognises a load that moved in one direction only: its dry friction is a constant force, equivalent to an offset.

Such a record cannot distinguish friction from an offset of the force, so the report states the offset and the reversal
that would distinguish them.
"""

from __future__ import annotations

import itertools

import numpy as np

from hal.arrays import Array
from tools.mismatch.engine.fit import Fit
from tools.mismatch.engine.problem import Problem
from tools.mismatch.engine.report import BaseShift, OneWay, ParameterValue

BLOCKS = 200
BACKWARDS = 0.01
"""Largest share of the travel that may run backwards (noise, ringing) in a record of one direction."""
MOST = 0.8
"""Least share of the motion between blocks that must exceed the noise before its direction counts."""
REVERSAL = 0.1
"""Least reversal, as a share of the travel, that is visible beside play and bristles."""


def direction(y: Array, noise_rms: float, *, is_rate: bool) -> int:
    """Return 1 or -1 if ``y`` (n,), a position or its rate, moved in that direction only; 0 if it turned or rested.

    Means over blocks are compared, four standard errors of the noise apart, over the shortest blocks between which most
    of the motion exceeds the noise.
    """
    blocks = int(np.clip(y.size // 20, 4, BLOCKS))
    while blocks >= 4:
        edges = np.linspace(0, y.size, blocks + 1).astype(int)
        mean = np.array([float(np.mean(y[a:b])) for a, b in itertools.pairwise(edges)])
        error = 4.0 * noise_rms / np.sqrt(y.size / blocks)
        moved = mean if is_rate else np.diff(mean)
        clear = np.where(np.abs(moved) > (error if is_rate else np.sqrt(2.0) * error), moved, 0.0)
        if float(np.sum(np.abs(clear))) > MOST * float(np.sum(np.abs(moved))):
            forward, back = float(np.sum(np.maximum(clear, 0.0))), float(-np.sum(np.minimum(clear, 0.0)))
            turned = min(forward, back) > BACKWARDS * max(forward, back)
            return 0 if turned else 1 if forward > back else -1
        blocks //= 2
    return 0


def one_way(problem: Problem, fitted: Fit, shifts: list[BaseShift]) -> OneWay | None:
    """Return the open question of a mechanical twin's record of one direction.

    Returns None if the load turned, or if friction has no place. ``shifts``: the base parameters as given and
    re-fitted, which contain the offset if the twin has one.
    """
    twin = problem.twin
    o = twin.feedback_on
    if not o or o not in problem.recording.outputs:
        return None
    is_rate = bool(twin.counted) or o == "velocity"
    y = problem.recording.outputs[o]
    sign = direction(y, problem.sigma(o), is_rate=is_rate)
    if sign == 0:
        return None
    travel = float(np.sum(np.abs(y)) * problem.recording.dt) if is_rate else float(np.ptp(y))
    unit = twin.units[o].removesuffix("/s") if is_rate else twin.units[o]
    return OneWay(o, sign, _offset(problem, shifts), REVERSAL * travel, unit)


def _offset(problem: Problem, shifts: list[BaseShift]) -> ParameterValue | None:
    """Return the re-fitted offset of the force less the given one, in the unit of the force."""
    by_name = {b.name: b for b in shifts}
    if "offset_per_mass" not in by_name or "inverse_mass" not in by_name:
        return None
    per, inverse = by_name["offset_per_mass"], by_name["inverse_mass"]
    if inverse.with_effects == 0.0 or inverse.given == 0.0:
        return None
    value = per.with_effects / inverse.with_effects - per.given / inverse.given
    half = abs((per.ci95[1] - per.ci95[0]) / 2 / inverse.with_effects)
    return ParameterValue(value, problem.twin.units[problem.twin.inputs[0]], (value - half, value + half))
