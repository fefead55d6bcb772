"""An effect that depends on no signal by its definition is named only if what it explains follows none."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from sim_devices.physics.catalogue import EFFECTS
from tests.unit.mismatch_model.made import recording
from tools.mismatch.engine.pose import prepared
from tools.mismatch.engine.residual import residuals
from tools.mismatch.engine.screen import places
from tools.mismatch.engine.trial import extended
from tools.mismatch.engine.unexplained import led_by
from tools.mismatch.infer import diagnose
from tools.mismatch.infer.density import undone


@pytest.mark.parametrize("hidden", [True, False])
def test_a_walk_is_named_only_if_what_it_explains_follows_no_signal(hidden: bool) -> None:
    rng = np.random.default_rng(4)
    n = 2400
    u = np.repeat(rng.uniform(0.0, 3.0, n // 60), 60)
    x, faded = np.empty(n), np.empty(n)
    x[0], faded[0] = u[0], 0.0
    for i in range(1, n):
        x[i] = x[i - 1] + 0.2 * (u[i - 1] - x[i - 1])
        faded[i] = faded[i - 1] + 0.02 * (u[i - 1] ** 2 - faded[i - 1])  # a memory that nothing records
    away = 0.02 * faded if hidden else np.cumsum(rng.normal(0.0, 0.012, n))
    y = x + away + rng.normal(0.0, 0.02, n)
    twin = {
        "states": {"x": {"unit": "V", "start": float(u[0])}}, "equations": {"x": "k * (u - x)"}, "outputs": {"y": "x"},
        "hold": "zero", "k": 0.223,
    }  # fmt: skip
    made = recording("ode", 1.0, {"u": u}, {"y": y}, {"u": "V", "y": "V"}, twin)
    report = diagnose(made, jobs=1, effects=[EFFECTS["random_walk"]])
    assert report.verdict == ("unexplained" if hidden else "missing_physics")
    assert [p.name for p in report.physics] == ([] if hidden else ["random_walk"])
    assert [(w.name, w.reason) for w in report.withheld] == ([("random_walk", "follows_signal")] if hidden else [])


def test_hum_in_front_of_a_converter_follows_nothing_that_it_rounds() -> None:
    n = 3000
    t = np.arange(n) / 1000.0
    u = 50.0 + 9.0 * (np.sin(50.0 * t) + 0.3 * np.sin(73.0 * t))
    hum = 0.4 * np.sin(2 * np.pi * 50.0 * t + 0.3)
    y = np.round(0.1 * u + hum)
    made = recording(
        "piezo_stack", 1e-3, {"command": u}, {"displacement": y}, {"command": "V", "displacement": "um"},
        {"gain_um_per_V": 0.1, "offset_um": 0.0},
    )  # fmt: skip
    problem, _, fitted = prepared(made, 0.3, 0, False)
    fitted = replace(fitted, theta=problem.given, residual=residuals(problem, fitted.model, problem.given))
    for name in ("mains_interference", "quantization"):
        (place, *_) = places(problem, (EFFECTS[name],), fitted.model.placed)
        placed = replace(place, settings={"step": (1.0,), "origin": (0.0,)} if name == "quantization" else {})
        model, theta = extended(problem, fitted, placed)
        if name == "mains_interference":
            theta[-3:] = 50.0, 0.4 * np.cos(0.3), 0.4 * np.sin(0.3)
        else:
            theta[model.slices(1)[0]] = 0.02  # a plain rounding
        fitted = replace(fitted, model=model, theta=theta, residual=residuals(problem, model, theta))
    course = undone(problem, fitted, "displacement", [0])
    assert np.corrcoef(course, hum[problem.index])[0, 1] > 0.9
    assert led_by(problem, fitted, "displacement", course) is None
    # the rounding of the reading without hum follows the command
    rounded = y[problem.index] - np.round(0.1 * u)[problem.index]
    assert led_by(problem, fitted, "displacement", rounded) is not None
