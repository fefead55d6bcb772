"""What a residual follows, on records of any length."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from sim_devices.physics.catalogue import EFFECTS
from tools.mismatch.engine import locate
from tools.mismatch.engine.assemble import led_by_physics
from tools.mismatch.engine.report import DependsOn


@pytest.mark.parametrize("samples", [3000, 3001, 3002])
def test_a_plants_own_motion_is_averaged_like_the_residual(monkeypatch: pytest.MonkeyPatch, samples: int) -> None:
    """Lengths that the thinning does and does not divide; a residual that goes with the plant's own motion."""
    whole = locate.thinned
    monkeypatch.setattr(locate, "thinned", lambda problem, fitted, output: whole(problem, fitted, output, limit=1000))
    rng = np.random.default_rng(1)
    t = np.arange(samples) * 1e-2
    motion = np.sin(2 * np.pi * 0.37 * t) + 0.5 * np.sin(2 * np.pi * 0.81 * t)
    residual = np.tanh(4 * motion) + 0.1 * rng.standard_normal(samples)
    problem: Any = SimpleNamespace(
        index=np.arange(samples),
        recording=SimpleNamespace(dt=1e-2, signals={"force": np.cos(2 * np.pi * 0.1 * t)}),
        twin=SimpleNamespace(static=False, drive=lambda output: "force"),
        measured={"position": motion + residual},
    )
    fitted: Any = SimpleNamespace(residual={"position": residual})
    found, _ = locate.follow(problem, fitted, "position")
    assert found[0].signal == "position"


@pytest.mark.parametrize(
    ("name", "first"), [("soft_iron", "field_z"), ("clock_skew", "time"), ("dead_time", "field_z")]
)
def test_what_signals_drive_follows_signals_however_slow_they_are(name: str, first: str) -> None:
    follows = [DependsOn("time", "cross product", 0.9), DependsOn("field_z", "value", 0.6)]
    placed = SimpleNamespace(effect=EFFECTS[name], outputs=("voltage_x",))
    fitted: Any = SimpleNamespace(model=SimpleNamespace(placed=[placed]))
    twin = SimpleNamespace(drive=lambda o: "", inputs=("field_x", "field_z"))
    problem: Any = SimpleNamespace(twin=twin, recording=SimpleNamespace(context={}))
    found = led_by_physics(problem, fitted, fitted, follows)
    assert (found[0].signal, len(found)) == (first, 2)
    if first != "time":
        assert led_by_physics(problem, fitted, fitted, [])[0].signal == "field_x"
