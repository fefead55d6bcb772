"""A sensor's gain and an amplifier's zero, on a pendulum whose simulation shows nothing of its inside."""

from __future__ import annotations

from dataclasses import replace

import numba
import numpy as np
import pytest

from tests.unit.mismatch_engine.cases import Array, recording
from tools.mismatch.infer import diagnose

RATE_HZ = 50.0
SUBSTEPS = 4
TRUE = {"gain": 8.0, "drag": 1.5, "pull": 30.0}
BELIEVED = {"gain": 7.6, "drag": 1.35, "pull": 28.0}


@numba.njit
def swung(u: Array, gain: float, drag: float, pull: float, dt: float) -> Array:
    """Return the angle (n,) of x'' = gain u - drag x' - pull sin x by the midpoint rule."""
    h = dt / SUBSTEPS
    x, v = 0.0, 0.0
    course = np.empty(u.size)
    for k in range(u.size):
        course[k] = x
        for _ in range(SUBSTEPS):
            middle = x + 0.5 * h * v
            speed = v + 0.5 * h * (gain * u[k] - drag * v - pull * np.sin(x))
            x += h * speed
            v += h * (gain * u[k] - drag * speed - pull * np.sin(middle))
    return course


def pendulum(inputs: dict[str, Array], p: dict[str, float], dt: float) -> dict[str, Array]:
    return {"position": swung(np.ascontiguousarray(inputs["force"]), p["gain"], p["drag"], p["pull"], dt)}


@pytest.mark.parametrize(
    ("gain", "bias", "zero", "named", "figure"),
    [
        (1.0, 0.0, 0.0, "", 0.0),
        (1.06, 0.0, 0.0, "scale_error", 1.06),
        (1.0, 0.15, 0.0, "constant_load", 0.15),
        (1.0, 0.0, 0.03, "zero_error", 0.03),
    ],
)
def test_an_ordinary_fault_of_a_sensor_or_an_amplifier_has_its_own_name(
    gain: float, bias: float, zero: float, named: str, figure: float
) -> None:
    rng = np.random.default_rng(5)
    u = np.repeat(rng.uniform(-2.0, 2.0, 100), 15)
    exact = pendulum({"force": u + bias}, TRUE, 1 / RATE_HZ)["position"]
    y = gain * exact + zero
    y += rng.normal(0.0, 3e-3 * float(np.std(y)), y.size)
    made = recording("python", {"force": u}, {"position": y}, dict(BELIEVED), rate_hz=RATE_HZ)
    report = diagnose(replace(made, twin=replace(made.twin, simulate=pendulum)), jobs=1)
    assert [p.name for p in report.physics] == ([named] if named else [])
    assert report.corrected_base["gain"] == pytest.approx(TRUE["gain"], rel=0.01)
    if not named:
        return
    (found,) = report.physics
    first = found.parameters[{"scale_error": "gain", "constant_load": "load", "zero_error": "zero"}[named]]
    assert first.value == pytest.approx(figure, rel=0.02)
    assert first.ci95[0] < figure < first.ci95[1]
