"""Damping that is not proportional to the speed: drag, and damping that grows with amplitude."""

from __future__ import annotations

import numpy as np

from sim_devices.physics.effect import Array, Context, Effect, Parameter, Parts, Settings, reports
from sim_devices.physics.forces import SPRING, packed
from sim_devices.physics.friction import velocity_of


def _drag_basis(x: Array, ctx: Context, q: Array, settings: Settings) -> Array:
    v = velocity_of(x, ctx)
    return (-np.abs(v) * v)[:, None]


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
    fill=lambda q, w, settings: packed("spring", SPRING, {4: w[0]}),
    report=reports(("quadratic_drag", "{in} s^2/{out}^2"), by_gain=True),
)


AMPLITUDE_DAMPING = Effect(
    name="amplitude_dependent_damping",
    summary="damping that grows or falls with the deflection",
    kind="feedback",
    by_position=True,
    stages=("mechanics",),
    parts=lambda settings: Parts((), (Parameter("growth", "1/({out}^2 s)"),)),
    equation=r"m\ddot x + (c + c_x x^2)\dot x + k x = F",
    source="B. van der Pol, Phil. Mag. 2 (1926) 978, eq. 1",
    excitation="small and large amplitudes near the resonance",
    confusable_with=("quadratic_drag", "coulomb_friction", "hysteresis"),
    basis=lambda x, ctx, q, settings: (-x * x * velocity_of(x, ctx))[:, None],
    fill=lambda q, w, settings: packed("spring", SPRING, {5: w[0]}),
    report=reports(("damping_per_square", "{in} s/{out}^3"), by_gain=True),
)
