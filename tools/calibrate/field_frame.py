"""Bias, scale and direction of a three-axis magnetometer from poses whose attitude is known (Ang 2004 sec. 3.2.2).

V = b + M C_WB^T B with the world field B unknown: only the product M B shows, so the mean scale is taken as nominal
and B comes out in those units. Hard iron turns with the body and is part of b, soft iron and misalignment part of M. A
reset pulse on the strap turns the sign of M and of the hard iron but not of the bridge's offset: (set - reset) / 2 is
free of that offset, (set + reset) / 2 is nothing else.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.stats import t as student

from hal.arrays import Array
from tools.calibrate.field_axes import strap
from tools.calibrate.multi_position import Estimate

NOMINAL_V_PER_UT = 0.01


@dataclass(frozen=True)
class FieldFrame:
    """Holds ``bias`` (V) and ``matrix`` (3, 3) (V/uT) with 95 % intervals, and ``offset_V`` if reset pulses were
    recorded."""

    bias: tuple[Estimate, ...]
    matrix: Array
    matrix_reach: Array
    field: Array
    residual_rms_V: float
    offset_V: tuple[Estimate, ...] | None


def fit_field(attitude: Array, set_V: Array, reset_V: Array | None = None) -> FieldFrame:
    """Fit bias and matrix from ``attitude`` (n, 3, 3), body to world, and outputs (n, 3) in V after set and reset
    pulses."""
    offset = None
    volts = set_V
    if reset_V is not None:
        turning, offset = strap(set_V, reset_V)
        volts = turning + np.array([e.value for e in offset])
    n = len(attitude)
    matrix, bias, field = NOMINAL_V_PER_UT * np.eye(3), volts.mean(axis=0), np.zeros(3)
    turned = attitude.transpose(0, 2, 1)
    design = np.empty((n, 4))
    for _ in range(200):
        # B, given M and bias: stack M C^T over all poses
        field, *_ = np.linalg.lstsq((matrix @ turned).reshape(3 * n, 3), (volts - bias).ravel(), rcond=None)
        design = np.column_stack([np.ones(n), turned @ field])
        solution, *_ = np.linalg.lstsq(design, volts, rcond=None)
        previous, bias, matrix = matrix, solution[0], solution[1:].T
        matrix = matrix * (NOMINAL_V_PER_UT / np.cbrt(abs(np.linalg.det(matrix))))
        if np.max(np.abs(matrix - previous)) < 1e-12:
            break
    field, *_ = np.linalg.lstsq((matrix @ turned).reshape(3 * n, 3), (volts - bias).ravel(), rcond=None)
    residual = volts - bias - (turned @ field) @ matrix.T
    # intervals given B: M and b are linear then
    freedom = max(1, n - 4)
    factor = float(student.ppf(0.975, freedom)) * np.sqrt(np.sum(residual**2, axis=0) / freedom)
    reach = factor[:, None] * np.sqrt(np.diag(np.linalg.pinv(design.T @ design)))
    return FieldFrame(
        tuple(map(Estimate.around, bias, reach[:, 0])),
        matrix,
        reach[:, 1:],
        field,
        float(np.sqrt(np.mean(residual**2))),
        offset,
    )
