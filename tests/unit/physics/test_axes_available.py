"""Effects of vectors are not proposed for an output that is no axis of one."""

from __future__ import annotations

import numpy as np

from sim_devices.physics.catalogue import EFFECTS
from sim_devices.physics.effect import Context

SIGNALS = {f"specific_force_{a}": np.sin(np.arange(50.0) + i) for i, a in enumerate("xyz")}


def test_a_turn_needs_an_axis() -> None:
    turn = EFFECTS["misalignment"].variants[0]
    assert turn.available is not None
    assert turn.available(SIGNALS, "voltage_x") == ""
    assert "no axis" in turn.available(SIGNALS, "volts_0")


def test_effects_of_other_axes_depend_on_signals_and_courses_in_time_do_not() -> None:
    independent = {n for n in EFFECTS if EFFECTS[n].is_independent}
    lines = {"mains_interference", "vibration"}
    assert independent == lines | {"thermal_drift", "step_shift", "random_walk", "spikes", "zero_error"}


def test_iron_changes_two_axes_by_one_figure() -> None:
    """B' = (I + S) B with S = S^T: what x takes of y, y takes of x."""
    field = {f"field_{a}": np.sin(np.arange(50.0) * (i + 1)) for i, a in enumerate("xyz")}
    weights = np.array([0.02, -0.03, 0.05])  # xy, xz, yz
    iron = EFFECTS["soft_iron"]
    assert iron.basis is not None
    matrix = np.array([[0.0, 0.02, -0.03], [0.02, 0.0, 0.05], [-0.03, 0.05, 0.0]])
    expected = matrix @ np.array(list(field.values()))
    for i, a in enumerate("xyz"):
        here = Context(0.001 * np.arange(50.0), 0.001, field, f"voltage_{a}", f"voltage_{a}", f"field_{a}")
        found = iron.basis(field[f"field_{a}"], here, np.zeros(0), {}) @ weights
        np.testing.assert_allclose(found, expected[i], atol=1e-12)
