"""What a name needs besides a good fit: every output it moves is looked at, honest noise, figures that can be."""

from __future__ import annotations

import numpy as np
import pytest

from sim_devices.physics.catalogue import EFFECTS
from sim_devices.physics.effect import Context
from tests.unit.mismatch_engine.cases import recording, wave
from tools.mismatch.simulate_sites import sites
from tools.mismatch.twins.make import make


def stack(gain: float = 0.125, n: int = 3000, noise: float = 0.02):
    """A stack whose output is a lagged command: (recording)."""
    rng = np.random.default_rng(5)
    u = 50 + 30 * wave(rng, n)
    return recording("piezo_stack", {"command": u}, {"displacement": gain * u + noise * rng.standard_normal(n)},
                     {"gain_um_per_V": gain, "offset_um": 0.0})  # fmt: skip


def test_a_force_is_judged_on_every_output_that_it_moves() -> None:
    t = np.arange(400) / 500.0
    x = np.sin(t)
    rec = recording("mechanical_axis", {"force": x}, {"position": x, "velocity": x}, {"mass": 1.0, "damping": 1.0})
    twin = make(rec)
    for effect in (EFFECTS["coulomb_friction"], EFFECTS["cubic_stiffness"]):
        assert {set(p.outputs) == {"position", "velocity"} for p in sites(twin, rec, effect)} == {True}
        assert all(p.outputs[0] == twin.feedback_on for p in sites(twin, rec, effect))


def test_late_warm_up_is_met_by_the_logistic_form() -> None:
    t = np.arange(4000) * 0.01
    residual = 0.8 / (1 + np.exp(-(t - 18.0) / 2.5))
    late = EFFECTS["thermal_drift"].variants[1]
    ctx = Context(t, 0.01, {}, "displacement", "displacement")
    settings = late.prepare(t, residual, ctx)
    middle, width = late.guess(np.sin(t), residual, ctx, settings)[0]
    assert middle == pytest.approx(18.0, abs=2.1)
    assert width == pytest.approx(2.5, abs=2.5)
    assert late.basis is not None
    column = late.basis(t, ctx, np.array([18.0, 2.5]), settings)[:, 0]
    np.testing.assert_allclose(0.8 * column, residual, atol=1e-12)
