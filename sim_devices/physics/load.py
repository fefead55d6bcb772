"""A constant force or flow: a weight on a vertical axis, the zero of an amplifier, a supply that always runs."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from sim_devices.physics.effect import Array, Context, Effect, Human, Parameter, Parts, Settings
from sim_devices.physics.forces import SPRING

SOURCE = (
    "A. Janot, M. Gautier, M. Brunot, Data set and reference models of EMPS, Workshop on Nonlinear System"
    " Identification Benchmarks (2019), eq. 1 (the offset)"
)


def _fill(q: Array, w: Array, settings: Settings) -> dict[str, Array]:
    row = np.zeros(SPRING)
    row[9] = w[0]
    return {"spring": row}


def _basis(x: Array, ctx: Context, q: Array, settings: Settings) -> Array:
    return np.ones((x.size, 1))


def _report(p: Array, settings: Settings, scale: float) -> Sequence[Human]:
    return (Human("load", float(p[0]) / (scale or 1.0), "{in}"),)


AT_INPUT = Effect(
    name="constant_load",
    summary="a constant beside an input: the zero of an amplifier",
    kind="add",
    stages=("amplifier", "actuator"),
    sites=("input",),
    parts=lambda settings: Parts((), (Parameter("load", "{in}"),)),
    equation=r"u' = u + u_0",
    source=SOURCE,
    excitation="motion both ways, without anything that holds the position",
    basis=_basis,
    report=_report,
    driven=False,
    shifts_line=True,
)

CONSTANT_LOAD = Effect(
    name="constant_load",
    summary="a force or flow that is always there: a weight, the zero of an amplifier",
    kind="feedback",
    stages=("mechanics", "actuator"),
    parts=lambda settings: Parts((), (Parameter("load", "{out}/s^2"),)),
    equation=r"m\ddot x + c\dot x + k x = F + F_0",
    source=SOURCE,
    excitation="motion both ways, without anything that holds the position",
    confusable_with=("coulomb_friction", "thermal_drift", "step_shift"),
    basis=_basis,
    fill=_fill,
    report=_report,
    acts_on=("motion", "storage"),
    variants=(AT_INPUT,),
)
