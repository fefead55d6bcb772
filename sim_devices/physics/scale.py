"""A gain that is wrong, of a sensor, an amplifier or an actuator, and the zero of a sensor."""

from __future__ import annotations

import numpy as np

from sim_devices.physics.effect import Effect, Human, Parameter, Parts, reports

SCALE_ERROR = Effect(
    name="scale_error",
    summary="the gain of a sensor, an amplifier or an actuator is another",
    kind="add",
    stages=("sensor", "amplifier", "actuator"),
    parts=lambda settings: Parts((), (Parameter("gain_error", "1"),)),
    equation=r"y = (1 + g)\, x",
    source="IEEE Std 1293-2018, section on the model equation: scale factor error",
    excitation="amplitudes at which the simulation is not linear, or a gain that is known in the simulation",
    confusable_with=("static_nonlinearity", "saturation"),
    basis=lambda x, ctx, q, settings: x[:, None],
    report=lambda p, settings, scale: (Human("gain", 1.0 + float(p[0]), "1"), Human("gain_error", float(p[0]), "1")),
    vanishes_with=(("gain_error",),),
    proportional=True,
    shifts_line=True,
)

ZERO_ERROR = Effect(
    name="zero_error",
    summary="the zero of a sensor is another",
    kind="add",
    stages=("sensor",),
    sites=("output",),
    parts=lambda settings: Parts((), (Parameter("zero", "{out}"),)),
    equation=r"y = x + y_0",
    source="IEEE Std 1293-2018, section on the model equation: bias",
    excitation="motion around more than one place, in a simulation that knows where zero is",
    confusable_with=("constant_load", "step_shift", "thermal_drift"),
    basis=lambda x, ctx, q, settings: np.ones((x.size, 1)),
    report=reports(("zero", "{out}")),
    driven=False,
    shifts_line=True,
)
