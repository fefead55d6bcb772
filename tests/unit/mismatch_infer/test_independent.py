"""An effect that depends on no signal by its definition is named only if what it explains follows none."""

from __future__ import annotations

import numpy as np
import pytest

from sim_devices.physics.catalogue import EFFECTS
from tests.unit.mismatch_model.made import recording
from tools.mismatch.infer import diagnose


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
