"""Dependence: right false-alarm rate on correlated noise, power on nonlinear relations, memory or function."""

import numpy as np
import pytest
from scipy.signal import lfilter
from scipy.stats import binom

from tools.mismatch.engine.dependence import (
    cross_fitted_share,
    dependences,
    follows_course,
    needs_memory,
    projected_energy,
)
from tools.mismatch.engine.features import Feature, curve, features_of, last_reversal

N = 3000
DT = 1e-2


def wander(rng: np.random.Generator, pole: float = 0.98) -> np.ndarray:
    x = lfilter([1.0], [1.0, -pole], rng.standard_normal(N))
    return x / x.std()


def noise(kind: str, rng: np.random.Generator) -> np.ndarray:
    if kind == "white":
        return rng.standard_normal(N)
    if kind == "red":
        return wander(rng, 0.9)
    if kind == "mixed":
        return wander(rng, 0.99) + rng.standard_normal(N)
    return rng.standard_t(3, N)


@pytest.mark.parametrize("kind", ["white", "red", "mixed", "heavy"])
def test_false_alarms_stay_at_the_nominal_rate(kind: str) -> None:
    rng = np.random.default_rng([11, len(kind)])
    runs = 60
    alarms = 0
    for _ in range(runs):
        x = wander(rng)
        found = dependences(noise(kind, rng), [Feature("x", "value", curve(x))])
        alarms += found[0].p_value < 0.05
    assert alarms <= binom.ppf(0.9999, runs, 0.07)


def test_many_features_are_corrected_for() -> None:
    rng = np.random.default_rng(5)
    runs = 12
    alarms = sum(
        min(d.p_value for d in dependences(noise("mixed", rng), features_of({"a": wander(rng), "b": wander(rng)}, DT)))
        < 0.05
        for _ in range(runs)
    )
    assert alarms <= binom.ppf(0.9999, runs, 0.07)


@pytest.mark.parametrize("seed", range(3))
def test_nonlinear_relation_is_found_and_the_decoy_is_not(seed: int) -> None:
    rng = np.random.default_rng([seed, 2])
    x, decoy = wander(rng), wander(rng)
    found = dependences(noise("red", rng) + 0.9 * np.abs(x), features_of({"x": x, "decoy": decoy}, DT, pairs=False))
    best = found[0]
    assert best.signal == "x"
    assert best.p_value < 1e-4
    assert all(d.p_value > 1e-4 or d.strength < best.strength / 2 for d in found if d.signal == "decoy")


def test_a_walk_follows_no_other_walk_and_a_curve_of_it_is_found_with_its_size() -> None:
    shares: list[float] = []
    for seed in range(12):
        rng = np.random.default_rng([seed, 7])
        x, own = (np.cumsum(rng.standard_normal(N)) for _ in range(2))
        heard = own / own.std() + 0.3 * rng.standard_normal(N)
        alone = follows_course(heard, features_of({"x": x}, DT))
        assert all(d.p_value > 1e-3 or d.strength < 0.1 for d in alone if d.signal != "time")
        z = (x - x.mean()) / x.std()
        best = follows_course(heard + 2.0 * np.abs(z), features_of({"x": x}, DT))[0]
        assert (best.signal, best.p_value < 1e-6) == ("x", True)
        shares.append(best.strength * float(np.var(heard + 2.0 * np.abs(z))) / float(np.var(2.0 * np.abs(z))))
    assert float(np.median(shares)) == pytest.approx(1.0, abs=0.15)


@pytest.mark.parametrize("seed", range(3))
def test_function_is_told_from_memory(seed: int) -> None:
    rng = np.random.default_rng([seed, 3])
    x = lfilter([1.0], [1.0, -0.9], wander(rng))
    x /= x.std()
    function = 0.5 * x**2 + 0.5 * rng.standard_normal(N)
    state = 0.6 * lfilter([0.05], [1.0, -0.95], np.abs(x)) + 0.2 * rng.standard_normal(N)
    features = features_of({"x": x}, DT)
    now = [f for f in features if f.kind in ("value", "rate")]
    past = [f for f in features if f.kind in ("running extremum", "recent history")]
    assert needs_memory(function, now, past) > 1e-3
    assert needs_memory(state, now, past) < 1e-6


def test_last_reversal_holds_the_turning_value() -> None:
    x = np.array([0.0, 1.0, 2.0, 1.0, 0.0, 1.0, 3.0, 2.0])
    assert last_reversal(x, 0.5).tolist() == [0.0, 0.0, 0.0, 2.0, 2.0, 0.0, 0.0, 3.0]


def test_projection_by_gram_equals_qr_even_with_dependent_columns() -> None:
    rng = np.random.default_rng(3)
    x = rng.standard_normal((600, 5)) * np.array([1.0, 1e-3, 1e4, 1.0, 1.0])
    x = np.column_stack([x, x[:, 0] + 1e-4 * x[:, 2], np.zeros(600)])
    e = rng.standard_normal(600) + 0.3 * x[:, 3]
    q, _ = np.linalg.qr(x[:, :5])
    energy, rank = projected_energy(e, x)
    assert rank == 5
    assert energy == pytest.approx(float(np.sum((q.T @ e) ** 2)), rel=1e-9)


@pytest.mark.parametrize("level", [0.0, 1e6])
def test_share_by_sums_of_products_is_that_of_two_plain_fits(level: float) -> None:
    rng = np.random.default_rng(4)
    columns = rng.standard_normal((960, 3)) * np.array([1.0, 50.0, 1e-3])
    e = columns[:, 0] + 0.01 * columns[:, 1] + rng.standard_normal(960)
    blocks = [(a, a + 90) for a in range(0, 960, 120)]
    halves = [np.concatenate([np.arange(a, b) for a, b in blocks[h::2]]) for h in (0, 1)]
    design = np.column_stack([np.ones(960), columns])
    lost = total = 0.0
    for fitted, held in (halves, halves[::-1]):
        weight = np.linalg.lstsq(design[fitted], e[fitted], rcond=None)[0]
        lost += float(np.sum((e[held] - design[held] @ weight) ** 2))
        total += float(np.sum((e[held] - e[fitted].mean()) ** 2))
    assert cross_fitted_share(e + level, columns, blocks) == pytest.approx(1 - lost / total, abs=1e-5)


def test_last_reversal_compiled_equals_python() -> None:
    x = wander(np.random.default_rng(5))[:500]
    np.testing.assert_array_equal(last_reversal(x, 0.3), last_reversal.py_func(x, 0.3))
