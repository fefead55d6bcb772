"""How well a fitted model predicts samples that no fit has seen: a Student-t density of the free run's residual.

The scale is the one that maximises the density on the fitted samples, so that a fit that only follows its own samples
pays for it on the others.
"""

from __future__ import annotations

import math
from collections.abc import Mapping

import numpy as np
from numpy.typing import NDArray

from tools.mismatch.engine.fit import Fit
from tools.mismatch.engine.problem import Problem

Array = NDArray[np.float64]

DEGREES = 5.0
"""Degrees of freedom: tails that heavy-tailed noise has."""
_CONSTANT = math.lgamma((DEGREES + 1) / 2) - math.lgamma(DEGREES / 2) - 0.5 * math.log(DEGREES * math.pi)
NORMAL = -1.4371
"""Mean log density of normal noise of unit rms under the best such density (by quadrature)."""
LATTICE = 0.1
"""Least scale in units of the lattice that readings sit on: beside an edge a reading may fall on either side."""
LEAST = 0.05
"""Least scale in units of the noise floor: a residual that is exactly zero is no infinite evidence."""


def student_scale(r: Array, least: float) -> float:
    """Maximum-likelihood scale of centred Student-t samples ``r`` (n,) (Lange et al. 1989)."""
    s = max(1.4826 * float(np.median(np.abs(r))), least)
    for _ in range(12):
        weight = (DEGREES + 1) / (DEGREES + (r / s) ** 2)
        s = max(float(np.sqrt(np.mean(weight * r * r))), least)
    return s


def student_log_density(r: Array, scale: float) -> Array:
    """Log density (n,) of each of ``r``, in nats."""
    return _CONSTANT - math.log(scale) - 0.5 * (DEGREES + 1) * np.log1p((r / scale) ** 2 / DEGREES)


def log_density(problem: Problem, fitted: Fit) -> dict[str, Array]:
    """Log density (m,) of every sample of the view, per output.

    What an effect takes as its own event is predicted by nothing but the range of the recording: such a sample pays the
    density of a uniform distribution over it.
    """
    out: dict[str, Array] = {}
    for o in problem.twin.outputs:
        r = fitted.residual[o]
        excused = fitted.model.excused(problem.view, o)
        usual = problem.fit_rows[~excused[problem.fit_rows]]
        floor = problem.floors[o]
        least = max(LEAST * floor.rms, LATTICE * floor.step, 1e-300)
        d = student_log_density(r, student_scale(r[usual] if usual.size else r, least))
        out[o] = np.where(excused, -math.log(max(float(np.ptp(problem.measured[o])), 1e-300)), d)
    return out


def best_log_density(problem: Problem) -> Mapping[str, float]:
    """The mean log density per output that normal noise at the floor would have: no model predicts much better."""
    return {o: NORMAL - math.log(max(problem.sigma(o), 1e-300)) for o in problem.twin.outputs}
