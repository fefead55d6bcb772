"""What a name needs besides a good fit: every output it moves is looked at, honest noise, figures that can be."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from sim_devices.physics.catalogue import EFFECTS
from sim_devices.physics.effect import Context
from tests.unit.mismatch_engine.cases import recording, wave
from tools.mismatch.engine.diagnose import prepared
from tools.mismatch.engine.families import in_disguise
from tools.mismatch.engine.noise import NoiseFloor
from tools.mismatch.engine.parsimony import Rule, as_good
from tools.mismatch.engine.screen import Candidate, bend, places
from tools.mismatch.engine.trial import Trial, extended, screen_one
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


def test_a_noise_floor_falls_to_what_a_better_model_leaves_but_not_when_it_was_declared() -> None:
    problem, _, base = prepared(stack(), 0.3, 0, False)
    true = problem.floors["displacement"].rms
    too_loud = NoiseFloor(2 * true, 0.1 * true, 2 * true, 0.0, "spectrum", False)
    loud = problem.with_floors({"displacement": too_loud})
    assert loud.quieter(base.residual).floors["displacement"].rms == pytest.approx(0.02, rel=0.06)
    declared = problem.with_floors({"displacement": replace(too_loud, method="declared")})
    assert declared.quieter(base.residual) is declared


@pytest.mark.parametrize(("share", "refused"), [(0.2, False), (-1.0, True)])
def test_creep_that_takes_all_of_the_mean_away_is_no_creep(share: float, refused: bool) -> None:
    problem, _, base = prepared(stack(), 0.3, 0, False)
    place = places(problem, (EFFECTS["creep"],), ())[0]
    candidate = screen_one(problem, base, place, bend(problem, base))
    model, theta = extended(problem, base, candidate.placed)
    weights = model.slices(0)[1]
    theta[weights] = 0.0
    theta[weights.start] = share * 0.125
    fitted = replace(base, model=model, theta=theta)
    trial = Trial(candidate.placed, candidate, fitted, None, {}, np.empty((0, 0)), 0)
    assert in_disguise(trial) is refused


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


@pytest.mark.parametrize(("lag", "memory", "before", "plain"), [(5.0, 1.1, 494.0, True), (209.0, 170.0, 1700.0, False)])
def test_one_number_is_named_beside_a_family_unless_it_leaves_far_more_than_the_noise(
    lag: float, memory: float, before: float, plain: bool
) -> None:
    problem, _, base = prepared(stack(n=600), 0.3, 0, False)
    one, many = (
        Trial(place, Candidate(place, 1.0, 0.0, False, ()), base, None, {"displacement": left}, np.ones((4, 1)), 0)
        for name, left in (("first_order_lag", lag), ("rate_dependent_hysteresis", memory))
        for place in places(problem, (EFFECTS[name],), ())[:1]
    )
    assert as_good(one, many, Rule(), "displacement", before) is plain
