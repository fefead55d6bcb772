"""A gain that is nothing but a parameter of the twin has no place beside it."""

from __future__ import annotations

import numpy as np
import pytest

from sim_devices.physics.catalogue import EFFECTS
from tests.unit.mismatch_engine.cases import recording
from tools.mismatch.engine.imitated import imitated
from tools.mismatch.engine.pose import prepared

RATE_HZ = 500.0
GAIN = {"scale_error[displacement]", "scale_error[command]"}
ZERO = "zero_error[displacement]"
DAMPING, SPRING = "viscous_friction[speed]", "linear_stiffness[speed]"


@pytest.mark.parametrize(
    ("equation", "fixed", "labels"),
    [
        ("gain * command - drag * speed - pull * displacement", [], GAIN | {ZERO, DAMPING, SPRING}),
        # the gain of a command that is known is another thing, and so is that of a pendulum's sensor
        ("gain * command - drag * speed - pull * displacement", ["gain"], {ZERO, DAMPING, SPRING}),
        (
            "gain * command - drag * speed - pull * sin(displacement)",
            [],
            {"scale_error[command]", ZERO, DAMPING},
        ),
        # a term that the twin has is its own; one that it lacks, or knows, may be missing
        ("gain * command - pull * displacement", ["drag"], GAIN | {ZERO, SPRING}),
        ("gain * command - drag * speed - pull * displacement", ["drag", "gain"], {ZERO, SPRING}),
        # the start state takes a zero where nothing holds the position
        ("gain * command - drag * speed", ["pull"], GAIN | {DAMPING}),
    ],
)
def test_only_what_the_parameters_do_exactly_is_theirs(equation: str, fixed: list[str], labels: set[str]) -> None:
    rng, n = np.random.default_rng(3), 2000
    u = np.repeat(rng.uniform(-1.0, 1.0, n // 20), 20)
    x, v, y = 0.0, 0.0, np.empty(n)
    for k in range(n):
        y[k] = x
        for _ in range(10):
            v += (40.0 * u[k] - 3.0 * v - 30.0 * np.sin(x)) / RATE_HZ / 10
            x += v / RATE_HZ / 10
    own: dict[str, object] = {
        "hold": "zero",
        "states": {"displacement": "um", "speed": "um/s"},
        "equations": {"displacement": "speed", "speed": equation},
        "fixed": fixed,
        **{"gain": 41.0, "drag": 3.1, "pull": 29.0},
    }
    made = recording("ode", {"command": u}, {"displacement": y + rng.normal(0.0, 1e-3, n)}, own, rate_hz=RATE_HZ)
    problem, _, base = prepared(made, 0.3, 0, False)
    linear = ("viscous_friction", "linear_stiffness", "linear_loss")
    lines = [EFFECTS[name] for name in ("scale_error", "zero_error", *linear, "constant_load", "saturation")]
    assert imitated(problem, base, lines) == labels
