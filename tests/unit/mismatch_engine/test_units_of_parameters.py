"""Units of what an effect reports: before and after the base physics, whatever it sits on."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import pytest

from sim_devices.physics.catalogue import EFFECTS
from tests.unit.mismatch_model.made import recording
from tools.mismatch.engine.found import _units
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
    problem = cast(Any, SimpleNamespace(twin=twin))
    assert _units(problem, unit, target, output, placed) == shown
