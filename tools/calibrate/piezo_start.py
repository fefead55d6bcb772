"""Finds the lag of a stack from the step with which a recording begins.

Loops of one size and rate cannot tell a lag from hysteresis: both widen the loop. Many recordings begin with a step,
because the amplifier stood at 0 V before the first sample. There the displacement follows a drive that hardly changes,
and what it needs to arrive is the lag.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
from scipy.optimize import minimize

from hal.arrays import Array
from tools.calibrate.piezo_dynamics import MAX_LAG_S, TAPS, Dynamics
from tools.calibrate.piezo_regression import Piece, Shape, axes_of, fit, residual

FIRST_S = 0.1
FASTER = 3.0
"""A recording begins with a step when the displacement moves so many times faster than it ever does later."""


def begins_with_step(drive: Array, z: Array, dt: float) -> bool:
    """Return True if the displacement (n,) um rushes from rest at 0 V to where the drive (n,) V already is."""
    first = max(2, round(FIRST_S / dt))
    if drive[0] < drive.min() + 0.2 * np.ptp(drive) or len(z) < 4 * first:
        return False
    steps = np.abs(np.diff(z))
    return bool(steps[:first].max() > FASTER * steps[2 * first :].max())


def from_rest(piece: Piece) -> Piece:
    """The piece with ``TAPS`` samples at 0 V before it; what was its first row is its first one still."""
    return replace(
        piece,
        drive=np.concatenate([np.zeros(TAPS), piece.drive]),
        z=np.concatenate([np.full(TAPS, piece.z[0]), piece.z]),
        rate=np.concatenate([np.zeros(TAPS), piece.rate]),
        rows=slice(piece.rows.start + TAPS, piece.rows.stop + TAPS),
    )


def fit_lag(pieces: list[Piece], shape: Shape, centre_V: float) -> tuple[list[Piece], Dynamics]:
    """Dead time and first-order lag that explain ``pieces`` best, and the pieces with that response."""

    def answering(dynamics: Dynamics) -> list[Piece]:
        return [replace(p, response=dynamics.response(p.dt)) for p in pieces]

    def misfit(p: Array) -> float:
        delay_s, lag_s = float(p[0]) * dt, float(p[1]) * dt
        if not (0.0 <= delay_s <= MAX_LAG_S and 0.01 * dt <= lag_s <= 5.0 * MAX_LAG_S):
            return 1e6
        late = answering(Dynamics(delay_s, lag_s))
        axes = axes_of(late, shape, centre_V)
        solution, _ = fit(late, shape, axes, [])
        return float(np.mean([np.var(residual(p, shape, axes, solution)) for p in late]))

    dt = pieces[0].dt
    minimum: Any = minimize(
        misfit, [0.5, 2.0], method="Nelder-Mead", options={"maxfev": 80, "xatol": 0.02, "fatol": 1e-6}
    )
    dynamics = Dynamics(float(minimum.x[0]) * dt, float(minimum.x[1]) * dt)
    return answering(dynamics), dynamics
