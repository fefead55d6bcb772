"""What a residual follows, on records of any length."""

from __future__ import annotations

import numpy as np
import pytest

from sim_devices.physics.catalogue import EFFECTS
from tests.unit.mismatch_model.made import recording
from tools.mismatch.engine import locate
from tools.mismatch.engine.assemble import led_by_physics
from tools.mismatch.engine.fit import Fit
from tools.mismatch.engine.problem import Problem
from tools.mismatch.engine.report import DependsOn
from tools.mismatch.engine.split import Split
from tools.mismatch.placed import Placed
from tools.mismatch.recording import Recording
from tools.mismatch.simulate import Model
from tools.mismatch.twins.make import make


def posed(rec: Recording) -> Problem:
    """The whole recording as its own fit."""
    return Problem(rec, make(rec), Split(rec.n, ((0, rec.n),), (), (), ()), 0, 0)


def fit_of(rec: Recording, *placed: Placed, residual: dict[str, np.ndarray] | None = None) -> Fit:
    model = Model(make(rec), placed)
    return Fit(model, model.start(rec), residual or {}, 0.0, (), 0)


@pytest.mark.parametrize("samples", [3000, 3001, 3002])
def test_a_plants_own_motion_is_averaged_like_the_residual(monkeypatch: pytest.MonkeyPatch, samples: int) -> None:
    """Lengths that the thinning does and does not divide; a residual that goes with the plant's own motion."""
    whole = locate.thinned
    monkeypatch.setattr(locate, "thinned", lambda problem, fitted, output: whole(problem, fitted, output, limit=1000))
    rng = np.random.default_rng(1)
    t = np.arange(samples) * 1e-2
    motion = np.sin(2 * np.pi * 0.37 * t) + 0.5 * np.sin(2 * np.pi * 0.81 * t)
    residual = np.tanh(4 * motion) + 0.1 * rng.standard_normal(samples)
    rec = recording(
        "mechanical_axis", 1e-2, {"force": np.cos(2 * np.pi * 0.1 * t)}, {"position": motion + residual},
        {"force": "N", "position": "m"}, {"mass": 1.0, "damping": 0.5, "stiffness": 10.0},
    )  # fmt: skip
    problem, fitted = posed(rec), fit_of(rec, residual={"position": residual})
    found, _ = locate.follow(problem, fitted, "position")
    assert found[0].signal == "position"


@pytest.mark.parametrize(
    ("name", "first"), [("soft_iron", "field_z"), ("clock_skew", "time"), ("dead_time", "field_z")]
)
def test_what_signals_drive_follows_signals_however_slow_they_are(name: str, first: str) -> None:
    follows = [DependsOn("time", "cross product", 0.9), DependsOn("field_z", "value", 0.6)]
    zero = np.zeros(100)
    rec = recording(
        "magnetometer", 0.01, {"field_x": zero, "field_z": zero}, {"voltage_x": zero},
        {"field_x": "uT", "field_z": "uT", "voltage_x": "V"}, {"bias_V": 2.5, "scale_V_per_uT": 0.01},
    )  # fmt: skip
    effect = EFFECTS[name]
    site = "input" if effect.name == "soft_iron" else "output"
    target = "field_x" if site == "input" else "voltage_x"
    placed = Placed(effect, site, target, effect.stages[0], ("voltage_x",))
    problem, fitted = posed(rec), fit_of(rec, placed)
    found = led_by_physics(problem, fitted, fitted, follows)
    assert (found[0].signal, len(found)) == (first, 2)
    if first != "time":
        assert led_by_physics(problem, fitted, fitted, [])[0].signal == "field_x"
