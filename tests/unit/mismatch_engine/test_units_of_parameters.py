"""Units of what an effect reports: before and after the base physics, whatever it sits on."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from sim_devices.physics.catalogue import EFFECTS
from tests.unit.mismatch_model.made import recording
from tools.mismatch.engine.found import _units
from tools.mismatch.engine.problem import Problem
from tools.mismatch.engine.split import Split
from tools.mismatch.infer import diagnose
from tools.mismatch.placed import Placed
from tools.mismatch.twins.make import make

T = np.arange(100) * 0.01
MAGNETOMETER = recording(
    "magnetometer", 0.01, {"field_x": np.sin(T)}, {"voltage_x": np.cos(T)}, {"field_x": "uT", "voltage_x": "V"},
    {"bias_V": 2.5, "scale_V_per_uT": 0.01},
)  # fmt: skip
AXIS = recording(
    "mechanical_axis", 0.01, {"force": np.sin(T)}, {"position": np.cos(T)}, {"force": "N", "position": "m"},
    {"mass": 1.0, "damping": 0.5, "stiffness": 10.0},
)  # fmt: skip


@pytest.mark.parametrize(
    ("rec", "name", "site", "target", "unit", "shown"),
    [
        (MAGNETOMETER, "current_coupling", "output", "voltage_x", "{in}/A", "uT/A"),
        (MAGNETOMETER, "dead_zone", "input", "field_x", "{in}", "uT"),
        (AXIS, "coulomb_friction", "feedback", "position", "{in}", "N"),
        (AXIS, "dead_zone", "output", "position", "{in}", "m"),
        (AXIS, "dead_zone", "output", "position", "{out}", "m"),
    ],
)
def test_unit(rec: Any, name: str, site: Any, target: str, unit: str, shown: str) -> None:
    twin = make(rec)
    output = next(iter(rec.outputs))
    placed = Placed(EFFECTS[name], site, target, EFFECTS[name].stages[0], (output,))
    problem = Problem(rec, twin, Split(rec.n, ((0, rec.n),), (), (), ()), 0, 0)
    assert _units(problem, unit, target, output, placed) == shown


def test_an_axis_shows_its_mass() -> None:
    """The base parameters of a report are those of the file: the engine's own are ratios to the mass."""
    rng = np.random.default_rng(5)
    dt, n = 0.002, 3000
    force = np.repeat(rng.normal(0.0, 3.0, n // 20), 20)
    state, rows = np.zeros(2), np.empty(n)
    system = np.array([[0.0, 1.0], [-10.0 / 1.3, -0.5 / 1.3]])
    for k in range(n):  # Runge-Kutta of order 4 for the true mass of 1.3 kg
        rows[k] = state[0]

        def slope(x: Any, f: float = force[k]) -> Any:
            return system @ x + np.array([0.0, f / 1.3])

        a = slope(state)
        b = slope(state + dt / 2 * a)
        c = slope(state + dt / 2 * b)
        state = state + dt / 6 * (a + 2 * b + 2 * c + slope(state + dt * c))
    position = rows + rng.normal(0.0, 1e-3, n)
    rec = recording(
        "mechanical_axis", dt, {"force": force}, {"position": position}, {"force": "N", "position": "m"},
        {"mass": 1.0, "damping": 0.5, "stiffness": 10.0, "hold": "zero"},
    )  # fmt: skip
    fit = diagnose(rec, jobs=1, effects=[]).fit
    shown = {b.name: b for b in fit.base_human}
    assert list(shown) == ["mass", "damping", "stiffness", "offset_force"]
    mass = shown["mass"]
    assert (mass.unit, mass.given) == ("N s^2/m", 1.0)
    assert mass.with_effects == pytest.approx(1.3, rel=0.01)
    assert mass.ci95[0] < 1.3 < mass.ci95[1]
