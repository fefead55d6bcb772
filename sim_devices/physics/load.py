"""A constant force or flow: a weight on a vertical axis, the zero of an amplifier, a supply that always runs."""

from __future__ import annotations

import numpy as np

from sim_devices.physics.effect import Effect, Parameter, Parts, reports
from sim_devices.physics.forces import SPRING, packed

SOURCE = (
    "A. Janot, M. Gautier, M. Brunot, Data set and reference models of EMPS, Workshop on Nonlinear System"
    " Identification Benchmarks (2019), eq. 1 (the offset)"
)


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
    basis=lambda x, ctx, q, settings: np.ones((x.size, 1)),
    report=reports(("load", "{in}"), by_gain=True),
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
    basis=lambda x, ctx, q, settings: np.ones((x.size, 1)),
    fill=lambda q, w, settings: packed("spring", SPRING, {9: w[0]}),
    report=reports(("load", "{in}"), by_gain=True),
    acts_on=("motion", "storage"),
    variants=(AT_INPUT,),
)
