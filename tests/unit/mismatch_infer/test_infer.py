"""The score of a set of effects and what is decided from it."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import replace

import numpy as np
import pytest
from scipy.integrate import quad
from scipy.signal import lfilter
from scipy.stats import beta
from scipy.stats import t as student

from sim_devices.physics.catalogue import EFFECTS
from tests.unit.mismatch_engine.cases import recording, wave
from tools.mismatch.engine.screen import places
from tools.mismatch.infer import density, diagnose
from tools.mismatch.infer.constants import START, Constants, constants_for, learned, vouched
from tools.mismatch.infer.count import Count
from tools.mismatch.infer.decide import TESTED, accepted, dispensable, is_whole, log_odds, stated, surenesses
from tools.mismatch.infer.density import DEGREES, NORMAL, student_log_density, student_scale
from tools.mismatch.infer.run import infer
from tools.mismatch.infer.store import Store
from tools.mismatch.recording import Recording

N = 2500


def test_the_density_is_the_one_of_scipy_and_its_scale_the_likeliest() -> None:
    r = 0.3 * student.rvs(DEGREES, size=20_000, random_state=1)
    s = student_scale(r, 1e-9)
    assert s == pytest.approx(0.3, rel=0.03)
    assert np.allclose(student_log_density(r, s), student.logpdf(r, DEGREES, scale=s))
    best = student_log_density(r, s).mean()
    assert all(student_log_density(r, f * s).mean() < best for f in (0.9, 1.1))


def test_what_normal_noise_scores_at_most() -> None:
    r = np.random.default_rng(2).standard_normal(400_000)
    assert student_log_density(r, student_scale(r, 1e-9)).mean() == pytest.approx(NORMAL, abs=0.003)


class _Store:
    """The part of a store that a score reads; noise has zero nats per sample."""

    score, lost, short = Store.score, Store.lost, Store.short

    def __init__(self, count: Count, constants: Constants, outputs: int = 1) -> None:
        self.count, self.constants, self.outputs = count, constants, float(outputs)
        self._best = {"y": 0.0, **{f"idle{i}": 0.0 for i in range(outputs - 1)}}


class _Set:
    """The part of a scored set that its score reads."""

    def __init__(self, density: float, laws: int, parameters: int, idle: int = 0, choices: float = 0.0) -> None:
        self.density = {"y": density, **{f"idle{i}": 0.0 for i in range(idle)}}
        self.laws, self.parameters, self.choices, self.proper = laws, parameters, choices, True


def test_a_name_and_a_parameter_have_their_price() -> None:
    c = replace(START, per_name=5.0, per_parameter=0.5)
    store = _Store(Count(200.0, 50.0), c)
    assert store.score(_Set(0.1, 1, 3)) == pytest.approx(200 * 0.1 - 5 - 1.5)
    assert store.score(_Set(0.1, 1, 3, choices=2.0)) == pytest.approx(200 * 0.1 - 5 - 2 - 1.5)
    assert store.score(_Set(0.1, 2, 3)) == pytest.approx(200 * 0.1 - 10 - 1.5)
    assert store.score(_Set(-0.2, 0, 0)) == pytest.approx(-store.count.lost(0.2))
    assert _Store(Count(200.0, 50.0), c, 4).score(_Set(-0.2, 0, 0, idle=3)) == pytest.approx(-store.count.lost(0.2) / 4)


@pytest.mark.parametrize("count", [Count(218.0, 50.0), Count(300.0, 300.0), Count(900.0, 4.0)])
def test_a_residual_counts_as_noise_near_the_noise_and_as_a_form_error_far_from_it(count: Count) -> None:
    def freedom(short: float) -> float:
        """Welch and Satterthwaite: the variances are exp(2 short) of the whole and 1 of the noise."""
        whole = math.exp(2.0 * short)
        return whole**2 / (1.0 / count.noise + (whole - 1.0) ** 2 / count.form)

    for short in (0.003, 0.1, 1.0, 3.0):
        assert count.lost(short) == pytest.approx(quad(freedom, 0.0, short, epsabs=1e-10)[0], rel=1e-8)
    step = 1e-6
    assert (count.lost(step) - count.lost(-step)) / (2.0 * step) == pytest.approx(count.noise, rel=1e-3)
    assert count.lost(8.0) - count.lost(7.0) == pytest.approx(count.form, rel=1e-3)
    assert math.isfinite(count.lost(math.inf))


def test_a_curve_gains_no_more_than_the_noise_leaves() -> None:
    count = Count(200.0, 50.0)
    assert count.curve_gain(1.0, 0.5) == pytest.approx(count.lost(1.0) - count.lost(1.0 - 0.5 * math.log(2.0)))
    assert count.curve_gain(0.1, 0.9) == pytest.approx(count.lost(0.1))
    assert count.curve_gain(-0.1, 0.9) == 0.0


def test_two_equal_sets_share_the_probability_and_the_map_is_monotone() -> None:
    sets = [(frozenset("ab"), 1.0), (frozenset("ac"), 1.0), (frozenset(), -60.0)]
    sure = surenesses(frozenset("ab"), sets, True, START)
    assert sure["b"] == pytest.approx(0.5)
    assert sure["a"] > 0.999
    cautious = replace(START, sure_offset=-0.5, sure_slope=0.3)
    values = [stated(p, True, cautious) for p in (0.01, 0.5, 0.9, 1.0)]
    assert values == sorted(values)
    assert values[-1] < 0.99
    assert math.isfinite(log_odds(1.0))
    assert math.isfinite(log_odds(0.0))


Sets = list[tuple[frozenset[str], float]]


def too_many(sets: Sets, known: bool, alone: Mapping[str, float] | None = None) -> frozenset[str]:
    """Those of a and b that may be one too many; ``alone``: the scores of a and b without the other."""
    scores = {**dict(sets), **{frozenset(n): v for n, v in (alone or {}).items()}}
    c = replace(START, sure_open=2.0)
    return dispensable(frozenset("ab"), sets, known, c, lambda kept: scores.get(kept, -math.inf))


def test_a_name_that_may_be_one_too_many_is_told_from_one_of_two_equals() -> None:
    extra = [(frozenset("ab"), 0.0), (frozenset("a"), -0.2), (frozenset("b"), -30.0), (frozenset(), -60.0)]
    equals = [(frozenset("ab"), 0.0), (frozenset("ac"), -0.2), (frozenset("a"), -30.0)]
    assert too_many(extra, False) == {"b"}
    assert too_many(equals, False) == set()
    assert too_many(extra, True) == {"b"}
    assert too_many([(of, v - 4.0 * (of != frozenset("ab"))) for of, v in extra], True) == set()
    either = [(frozenset("ab"), 0.0), (frozenset("a"), -0.2), (frozenset("b"), -0.3), (frozenset(), -60.0)]
    assert too_many(either, False) == {"b"}
    # two others in the place of one say as well that the rest is too few
    two = [(frozenset("ab"), 0.0), (frozenset("acd"), -0.2), (frozenset("a"), -30.0), (frozenset(), -60.0)]
    assert too_many(two, True) == set()


def test_of_two_that_one_other_replaces_the_one_goes_that_costs_less() -> None:
    """Friction and a loop beside it, in whose place another law of friction may be: friction stays."""
    one = [(frozenset("ab"), 0.0), (frozenset("c"), -2.0), (frozenset(), -900.0)]
    assert too_many(one, True, {"a": -20.0, "b": -500.0}) == {"b"}
    assert too_many(one, True, {"a": -500.0, "b": -20.0}) == {"a"}


def test_the_form_of_what_is_named_may_leave_its_share() -> None:
    c = replace(START, cut=0.5, cut_share=0.05)
    assert is_whole(0.4, 0.0, c)
    assert not is_whole(0.6, 0.0, c)
    assert is_whole(4.0, 100.0, c)
    assert not is_whole(6.0, 100.0, c)


def test_the_shipped_constants_are_complete() -> None:
    c = learned()
    assert Constants.of(c.to_json()) == c
    assert min(c.samples, c.per_name, c.per_parameter, c.least_z, c.sure_slope) > 0


def test_strangers_machines_limit_what_is_stated_for_a_kind_of_twin_that_the_calibration_lacks() -> None:
    known = vouched("ode")
    assert known is not None
    # the posterior mean of a share with a uniform prior is that of a beta distribution
    assert known.most == pytest.approx(beta(known.right + 1, known.names - known.right + 1).mean())
    c = constants_for("ode")
    assert stated(1.0, True, c) == known.most < stated(1.0, True, learned())
    assert stated(0.1, True, c) == stated(0.1, True, learned())
    assert vouched("piezo_stack") is None
    assert constants_for("piezo_stack") == learned()


def _stack(change: np.ndarray, u: np.ndarray) -> Recording:
    y = 0.12 * u + change + 0.01 * np.random.default_rng(5).standard_normal(u.size)
    return recording("piezo_stack", {"command": u}, {"displacement": y}, {"gain_um_per_V": 0.12, "offset_um": 0.0})


def test_nothing_is_named_where_nothing_is_missing() -> None:
    u = 40.0 * wave(np.random.default_rng(3), N)
    report = diagnose(_stack(np.zeros(N), u), jobs=1, constants=START)
    assert report.verdict == "agrees"
    assert not report.physics


def test_a_clipped_amplifier_is_named_and_the_report_is_that_of_the_other_engine() -> None:
    u = 40.0 * wave(np.random.default_rng(4), N)
    report = diagnose(_stack(0.12 * (np.clip(u, -22.0, 25.0) - u), u), jobs=1, constants=START)
    assert report.verdict == "missing_physics"
    assert {p.name for p in report.physics} == {"saturation"}
    assert 0.0 < report.physics[0].confidence <= 1.0
    body = report.to_json()
    assert body["format"] == 1
    assert body["fit"]["fitted_rms"]["displacement"] < 0.3 * body["fit"]["recalibrated_rms"]["displacement"]


def test_an_effect_that_is_not_in_the_vocabulary_is_a_full_member() -> None:
    """The same physics under a name of its own is named, priced and rivalled like any other."""
    u = 40.0 * wave(np.random.default_rng(4), N)
    known = EFFECTS["saturation"]
    mine = replace(known, name="clipped_by_a_stranger", variants=())
    others = [e for e in EFFECTS.values() if e.name in ("static_nonlinearity", "first_order_lag", "dead_zone")]
    report = diagnose(_stack(0.12 * (np.clip(u, -22.0, 25.0) - u), u), jobs=1, constants=START, effects=[*others, mine])
    assert {p.name for p in report.physics} == {"clipped_by_a_stranger"}
    assert {a.name for a in report.alternatives} <= {e.name for e in others}


@pytest.mark.parametrize("follows", ["offset", "gain", ""])
def test_a_walk_is_no_account_of_what_follows_a_recorded_signal(follows: str) -> None:
    """Nothing in the vocabulary is about humidity, which walks; the change is a curve of it, alone or times the
    output, or a walk of its own."""
    rng = np.random.default_rng(0)
    u = 40.0 * wave(rng, N)
    humidity, other = np.cumsum(rng.standard_normal((2, N)), axis=1) / np.sqrt(N)
    change = 0.08 * {"offset": np.abs(humidity), "gain": np.abs(humidity) * 0.12 * u, "": other}[follows]
    y = 0.12 * u + change + 0.005 * rng.standard_normal(N)
    stack = {"gain_um_per_V": 0.12, "offset_um": 0.0}
    r = recording("piezo_stack", {"command": u}, {"displacement": y}, stack, context={"humidity": humidity})
    store = infer(r, START, jobs=1, effects=[EFFECTS["random_walk"]]).found.store
    (walk,) = (s for s in store.sets.values() if s.names)
    assert walk.proper != bool(follows)
    assert store.ranked()[0].names == (frozenset() if follows else {"random_walk"})


@pytest.mark.parametrize("follows", [True, False])
def test_a_walk_is_no_account_of_what_a_signal_explains_one_step_ahead(follows: bool) -> None:
    """An output that follows the input with three time constants has no creep of one, and the error of form is slow. A
    walk that is there is kept, beside the same rivals."""
    rng = np.random.default_rng(0)
    u = 40.0 * wave(rng, N)
    slow = sum(lfilter([1.0 / tau], [1.0, 1.0 / tau - 1.0], u) for tau in (20.0, 150.0, 1200.0))
    change = 0.06 * slow if follows else 0.05 * np.cumsum(rng.standard_normal(N)) / np.sqrt(N)
    names = ("random_walk", "creep", "backlash")
    store = infer(_stack(change, u), START, jobs=1, effects=[EFFECTS[n] for n in names]).found.store
    (place,) = places(store.problem, [EFFECTS["random_walk"]], ())
    walk = store.with_one(store.base, place)
    assert store.outdone(walk, store.sets.values()) == follows
    assert ("random_walk" in store.ranked()[0].names) != follows


def test_a_set_without_whose_drift_the_simulation_runs_away_is_scored(monkeypatch: pytest.MonkeyPatch) -> None:
    """Inside a loop the simulation without the drift may diverge; it ended the diagnosis with an error of lstsq."""
    u = 40.0 * wave(np.random.default_rng(4), N)
    r = _stack(0.4 * np.linspace(0.0, 1.0, N) ** 2, u)
    store = infer(r, START, jobs=1, effects=[EFFECTS["thermal_drift"]]).found.store
    drift = next(s for s in store.ranked() if s.names == {"thermal_drift"})
    monkeypatch.setattr(density, "undone", lambda problem, *_: np.full(problem.index.size, np.nan))
    assert store.scored(drift.fitted).proper


class _Ranked:
    """A store whose sets have been tested: the weakest test per set, best first."""

    def __init__(self, sets: list[tuple[str, float]]) -> None:
        self.constants = replace(START, least_z=3.0)
        self._sets = {_Named(names): z for names, z in sets}
        self.base = list(self._sets)[-1]

    def ranked(self) -> list[_Named]:
        return list(self._sets)

    def least_z(self, s: _Named) -> float:
        return self._sets[s]


class _Named:
    def __init__(self, names: str) -> None:
        self.names = frozenset(names)


def test_a_name_that_fails_in_the_best_sets_hides_no_smaller_one() -> None:
    worse = [(f"aw{i}", -1.0) for i in range(TESTED + 2)]
    store = _Ranked([*worse, ("a", 9.0), ("", math.inf)])
    assert [sorted(s.names) for s in accepted(store)] == [["a"], []]  # pyright: ignore[reportArgumentType]


def test_a_limit_that_no_fitted_sample_reached_says_nothing_about_others() -> None:
    """What is cut above alone gets no limit below."""
    u = 40.0 * wave(np.random.default_rng(5), N)
    limit = float(np.quantile(u, 0.95))
    y = 0.12 * np.minimum(u, limit) + 0.01 * np.random.default_rng(5).standard_normal(N)
    stack = {"gain_um_per_V": 0.12, "offset_um": 0.0}
    r = recording("piezo_stack", {"command": u}, {"displacement": y}, stack)
    store = infer(r, START, jobs=1, effects=[EFFECTS["saturation"]]).found.store
    (clipped,) = (s for s in store.sets.values() if s.names == {"saturation"} and s.proper)
    (lower, upper, _) = clipped.fitted.theta[clipped.fitted.model.slices(0)[0]]
    assert upper == pytest.approx(limit, rel=0.02)
    assert lower < u.min() - 0.2 * np.ptp(u)


def test_a_slow_drift_is_seen_beside_bursts() -> None:
    """Whitening by a filter that has learned bursts erases a drift."""
    rng = np.random.default_rng(6)
    u = 40.0 * wave(rng, N)
    change = 0.25 * (1.0 - np.exp(-np.arange(N) / 1500.0))
    for a in rng.choice(N - 60, 4, replace=False):
        change[a : a + 40] += 0.6 * rng.choice([-1.0, 1.0]) * np.sin(np.pi * np.arange(40) / 40)
    effects = [EFFECTS[n] for n in ("thermal_drift", "spikes", "saturation")]
    report = diagnose(_stack(change, u), jobs=1, constants=START, effects=effects)
    assert {p.name for p in report.physics} == {"thermal_drift", "spikes"}
