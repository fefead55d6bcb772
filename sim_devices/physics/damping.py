"""Damping that is not proportional to the speed: drag, and damping that grows with amplitude."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from sim_devices.physics.effect import Array, Context, Effect, Human, Parameter, Parts, Settings
from sim_devices.physics.forces import SPRING
from sim_devices.physics.friction import velocity_of


def _row(at: int, weights: Array) -> dict[str, Array]:
    row = np.zeros(SPRING)
    row[at] = weights[0]
    return {"spring": row}


def _drag_basis(x: Array, ctx: Context, q: Array, settings: Settings) -> Array:
    v = velocity_of(x, ctx)
    return (-np.abs(v) * v)[:, None]


def _drag_report(p: Array, settings: Settings, scale: float) -> Sequence[Human]:
    return (Human("quadratic_drag", float(p[0]) / (scale or 1.0), "{in} s^2/{out}^2"),)


QUADRATIC_DRAG = Effect(
    name="quadratic_drag",
    summary="resistance of a fluid, which goes with the square of the speed",
    kind="feedback",
    stages=("mechanics",),
    parts=lambda settings: Parts((), (Parameter("drag", "1/{out}", 0.0),)),
    equation=r"m\ddot x + c\dot x + k x = F - c_2 |\dot x|\dot x",
    source="J. R. Morison, M. P. O'Brien, J. W. Johnson, S. A. Schaaf, J. Petroleum Technology 2 (1950) 149, eq. 1",
    excitation="slow and fast motion",
    confusable_with=("coulomb_friction", "amplitude_dependent_damping"),
    basis=_drag_basis,
    fill=lambda q, w, settings: _row(4, w),
    report=_drag_report,
)


def _amplitude_basis(x: Array, ctx: Context, q: Array, settings: Settings) -> Array:
    return (-x * x * velocity_of(x, ctx))[:, None]


def _amplitude_report(p: Array, settings: Settings, scale: float) -> Sequence[Human]:
    return (Human("damping_per_square", float(p[0]) / (scale or 1.0), "{in} s/{out}^3"),)


AMPLITUDE_DAMPING = Effect(
    name="amplitude_dependent_damping",
    summary="damping that grows or falls with the deflection",
    kind="feedback",
    stages=("mechanics",),
    parts=lambda settings: Parts((), (Parameter("growth", "1/({out}^2 s)"),)),
    equation=r"m\ddot x + (c + c_x x^2)\dot x + k x = F",
    source="B. van der Pol, Phil. Mag. 2 (1926) 978, eq. 1",
    excitation="small and large amplitudes near the resonance",
    confusable_with=("quadratic_drag", "coulomb_friction", "hysteresis"),
    basis=_amplitude_basis,
    fill=lambda q, w, settings: _row(5, w),
    report=_amplitude_report,
)
