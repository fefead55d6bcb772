"""The matrices behind an FMU for model exchange, when its equations are linear."""

from __future__ import annotations

import ctypes
from collections.abc import Callable, Mapping
from typing import Any

import numpy as np

from hal.arrays import Array

Evaluate = Callable[[Array, Array, float], Array]

PROBES = 60
DECADES = (-3.0, 3.0)
"""Sizes of states and inputs that are tried, as powers of ten of their nominal values."""
LINEAR = 1e-9
"""Largest deviation from a linear map, as a share of the terms that were added, that still counts as rounding."""


MOST_UPDATES = 100
"""Largest number of updates of discrete states at the start."""


def unsettled(fmu: Any) -> str:
    """Update the discrete states at the start; return why the FMU cannot be integrated without events ("" if it can).

    FMI 2.0.4, section 3.2.2: they are updated until no more updates are needed.
    """
    for _ in range(MOST_UPDATES):
        more, _, _, _, timed, _ = fmu.newDiscreteStates()
        if timed:
            return "it has events in time, which are not met"
        if not more:
            return ""
    return f"its discrete states change still after {MOST_UPDATES} updates at the start"


def linear_equations(
    fmu: Any, description: Any, inputs: list[str], outputs: list[str], start: Mapping[str, Any]
) -> dict[str, Any] | None:
    """``A, B, C, D, x0`` with the ``states`` and their units, of an FMI 2 FMU at the parameters ``start``.

    None where the equations depend on time, have a constant term, are not linear, have events, or need other variables
    than real ones. ``fmu`` is an instance of FMPy for model exchange; it is used up.
    """
    known = {v.name: v for v in description.modelVariables}
    rates = [d.variable for d in description.derivatives]
    states = [r.derivative for r in rates]
    needed = [*states, *(known[n] for n in (*inputs, *outputs, *start) if n in known)]
    if not states or description.numberOfEventIndicators or any(v.type != "Real" for v in needed):
        return None
    n_x, n_u = len(states), len(inputs)
    fmu.setupExperiment(startTime=0.0)
    fmu.setReal([known[k].valueReference for k in start], [float(v) for v in start.values()])
    fmu.enterInitializationMode()
    fmu.exitInitializationMode()
    if unsettled(fmu):
        return None
    fmu.enterContinuousTimeMode()
    x, dx = (ctypes.c_double * n_x)(), (ctypes.c_double * n_x)()
    to, of = [known[s].valueReference for s in inputs], [known[o].valueReference for o in outputs]
    fmu.getContinuousStates(x, n_x)
    x0 = np.array(x)

    def evaluate(at: Array, u: Array, t: float) -> Array:
        fmu.setTime(t)
        x[:] = at.tolist()
        fmu.setContinuousStates(x, n_x)
        if to:
            fmu.setReal(to, u.tolist())
        fmu.getDerivatives(dx, n_x)
        return np.array([*dx, *fmu.getReal(of)])

    matrix = linear_map(evaluate, np.array([float(s.nominal or 1.0) for s in states]), n_u)
    if matrix is None:
        return None
    return {
        "A": matrix[:n_x, :n_x].tolist(),
        "B": matrix[:n_x, n_x:].tolist(),
        "C": matrix[n_x:, :n_x].tolist(),
        "D": matrix[n_x:, n_x:].tolist(),
        "x0": x0.tolist(),
        "states": {s.name: s.unit or "1" for s in states},
    }


def linear_map(evaluate: Evaluate, nominal: Array, n_u: int) -> Array | None:
    """The matrix (rows, states + inputs) that ``evaluate`` multiplies states and inputs by; None where it does not."""
    n_x = nominal.size
    scale = np.concatenate([nominal, np.ones(n_u)])

    def at(z: Array, t: float) -> Array:
        return evaluate(z[:n_x], z[n_x:], t)

    columns = [at(np.where(np.arange(scale.size) == i, scale, 0.0), 0.0) / scale[i] for i in range(scale.size)]
    matrix = np.stack(columns, axis=1)
    if not np.all(np.isfinite(matrix)) or np.any(at(np.zeros(scale.size), 0.0) != 0.0):
        return None
    rng = np.random.default_rng(0)
    for _ in range(PROBES):
        z = scale * rng.choice([-1.0, 1.0], scale.size) * 10.0 ** rng.uniform(*DECADES, scale.size)
        found, size = at(z, float(rng.uniform(0.0, 1e3))), np.abs(matrix) @ np.abs(z)
        if not np.all(np.abs(found - matrix @ z) <= LINEAR * np.maximum(size, 1e-300)):
            return None
    return matrix
