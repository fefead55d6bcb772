"""The evidence of several recordings is that of each, predicted by a fit that left it out."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from sim_devices.physics.catalogue import EFFECTS
from tests.unit.mismatch_together.test_together import write
from tools.mismatch.engine.fit import fit, fit_base
from tools.mismatch.engine.pose import Posed, prepared
from tools.mismatch.infer.constants import learned
from tools.mismatch.infer.pooled import CARRIED, PooledStore, folds_of, pool, pooled
from tools.mismatch.infer.run import infer
from tools.mismatch.infer.search import search
from tools.mismatch.together import load_together


def bent(folder: Path, k: int, amplitude_V: float) -> Path:
    """Write a stack whose displacement saturates softly beyond 70 V, driven with this amplitude about 50 V."""
    write(folder, k)
    t = np.arange(1200) / 200.0
    volts = 50 + amplitude_V * np.sin(2 * np.pi * (0.41 + 0.01 * k) * t + k)
    um = 0.12 * (volts - 0.25 * np.maximum(volts - 70.0, 0.0)) + np.random.default_rng(k).normal(0, 0.02, t.size)
    np.savetxt(folder / "data.csv", np.column_stack([volts, um]), delimiter=",", header="command_V,um", comments="")
    return folder


def test_each_recording_is_predicted_by_the_others(tmp_path: Path) -> None:
    joined = load_together([write(tmp_path / f"day{k}", k) for k in range(3)])
    found, _, _ = prepared(joined, 0.3, 0, False)
    problem = pooled(found)
    held = [row for fold in folds_of(problem) for row in fold.held_rows]
    assert sorted(held) == list(range(problem.index.size)) == list(problem.held_rows) == list(problem.fit_rows)
    base = fit_base(problem)
    left = PooledStore(problem, base, learned()).base.fitted.residual["displacement"]
    part_of = np.searchsorted([p.stop for p in joined.parts], problem.index, side="right")
    volts, um = joined.inputs["command"][problem.index], joined.outputs["displacement"][problem.index]
    moved: list[float] = []
    for k in range(3):
        others = part_of != k
        line = np.polyfit(volts[others], um[others], 1)
        expected = (um - np.polyval(line, volts))[~others]
        assert np.max(np.abs(left[~others] - expected)) < 0.005
        moved.append(float(np.max(np.abs(base.residual["displacement"][~others] - expected))))
    assert max(moved) > 0.05


def test_parameters_as_given_have_seen_no_recording(tmp_path: Path) -> None:
    joined = load_together([write(tmp_path / f"day{k}", k, n=300) for k in range(3)])
    found, raw, base = prepared(joined, 0.3, 0, False)
    store = PooledStore(pooled(found), base, learned())
    given = store.scored(raw).fitted.residual["displacement"]
    assert np.array_equal(given, raw.residual["displacement"])


def test_an_effect_that_two_of_nine_recordings_show_counts_in_both_parts(tmp_path: Path) -> None:
    loud = (2, 7)
    joined = load_together([bent(tmp_path / f"day{k}", k, 40.0 if k in loud else 15.0) for k in range(9)])
    found, _, base = prepared(joined, 0.3, 0, False)
    out = {k for k, p in enumerate(joined.parts) if any(a < p.stop and p.start < b for a, b in found.split.held_out)}
    assert len(out & set(loud)) == 1
    inferred = infer(joined, learned())
    best = inferred.found.store.ranked()[0]
    assert best.names & {"saturation", "static_nonlinearity", "dead_zone"}
    again = fit(inferred.found.store.problem, base.model, [base.theta])
    assert inferred.found.store.score(best) > inferred.found.store.score(inferred.found.store.scored(again))


def test_a_search_is_forgotten_when_its_best_sets_are_pooled(tmp_path: Path) -> None:
    """The caches and fits of a search are freed, and no score depends on them."""
    joined = load_together([write(tmp_path / f"day{k}", k, n=600) for k in range(4)])
    problem, raw, base = prepared(joined, 0.3, 0, False)
    effects = tuple(EFFECTS[n] for n in ("backlash", "saturation", "hysteresis"))
    posed = Posed(joined, effects, problem, raw, base, {})
    found = search(problem, base, effects, learned())
    searched = found.store.problem
    assert searched.view.memo
    assert any(t.fitted for t in found.first)
    expected = PooledStore(
        pooled(searched), fit(pooled(searched), base.model, [found.store.base.fitted.theta], iterations=15), learned()
    )
    for s in [s for s in found.store.ranked() if s.placed][:CARRIED]:
        expected.put(fit(pooled(searched), s.fitted.model, [s.fitted.theta], iterations=15))
    after, now = pool(found, posed)
    assert after.store.sets.keys() == expected.sets.keys()
    assert len(expected.sets) > 1
    assert [after.store.score(s) for s in after.store.sets.values()] == [
        expected.score(s) for s in expected.sets.values()
    ]
    assert now.problem is after.store.problem
    assert not searched.view.memo
    assert not searched.fit_view.memo
    assert not found.store.sets
    assert not any(t.fitted for t in after.first)
