"""The exact harness: seeds that never meet, scores without filters, runs that go on where they were stopped."""

from __future__ import annotations

import io
import json
from itertools import combinations
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from rich.console import Console

from tests.mismatch.test_prove import silent
from tools.research.prove.corpus import BLOCK, CORPORA, draw_case, first_block
from tools.research.prove.corpus_table import corpus_table
from tools.research.prove.exact import reliability, score_exactly, summarise
from tools.research.prove.harness import Run, run_corpus


def _answer(kind: str, *names: str, **more: Any) -> dict[str, Any]:
    effects = [
        {"name": n, "form": "f", "outputs": ["displacement"], "stages": ["sensor"], "depends": ["command"],
         "predictable": True, "figures": more.get("figures", {})}
        for n in names
    ]  # fmt: skip
    return {
        "kind": kind, "twin": "piezo_stack", "severity": 4.0, "excitation": "chirp", "effects": effects,
        "noise_kind": "white", "noise_rms": {"displacement": 0.1}, "decoys": [],
    }  # fmt: skip


def _report(verdict: str, *names: str, sure: float = 0.9, groups: tuple[tuple[str, ...], ...] = ()) -> dict[str, Any]:
    physics = [{"name": n, "output": "displacement", "confidence": sure, "parameters": {}} for n in names]
    return {"verdict": verdict, "physics": physics, "equivalent": [{"names": list(g)} for g in groups]}


def test_seeds_of_the_corpora_never_meet() -> None:
    for a, b in combinations(CORPORA.values(), 2):
        assert a.last < b.first or b.last < a.first
    for corpus in CORPORA.values():
        assert corpus.seed_of(0) == corpus.seed_of(BLOCK - 1) == corpus.first
        assert corpus.seed_of(BLOCK) == corpus.first + 1
        most = (corpus.last - corpus.first + 1) * BLOCK
        assert corpus.seed_of(most - 1) == corpus.last
        with pytest.raises(ValueError, match="beyond its last seed"):
            corpus.seed_of(most)
        with pytest.raises(ValueError, match="negative"):
            corpus.seed_of(-1)


def test_the_sealed_corpus_follows_the_revision_and_stays_in_its_range() -> None:
    sealed = CORPORA["sealed"]
    starts = {first_block(sealed, r) for r in ("a", "b", "c")}
    assert len(starts) == 3
    assert all(sealed.first <= sealed.seed_of(10_000, s) <= sealed.last for s in starts)
    assert first_block(CORPORA["develop"], "a") == 0


@pytest.mark.parametrize(
    ("answer", "report", "verdict", "exact", "grouped", "false"),
    [
        (_answer("single", "creep"), _report("missing_physics", "creep"), True, True, True, 0),
        (_answer("single", "creep"), _report("missing_physics", "creep", "creep"), True, True, True, 0),
        (_answer("single", "creep"), _report("missing_physics", "creep", "spikes"), True, False, False, 1),
        (_answer("single", "creep"), _report("unexplained", "creep"), False, False, False, 0),
        (_answer("single", "creep"), _report("missing_physics", "hysteresis"), True, False, False, 1),
        (
            _answer("single", "creep"),
            _report("missing_physics", "hysteresis", groups=(("hysteresis", "creep"),)), True, False, True, 1,
        ),
        (
            _answer("pair", "creep", "spikes"),
            _report("missing_physics", "spikes", "hysteresis", groups=(("hysteresis", "creep"),)),
            True, False, True, 1,
        ),
        (_answer("pair", "creep", "spikes"), _report("missing_physics", "creep"), True, False, False, 0),
        (_answer("agrees"), _report("agrees"), True, True, True, 0),
        (_answer("agrees"), _report("missing_physics", "creep"), False, False, False, 1),
        (_answer("unknown", "unknown"), _report("unexplained"), True, True, True, 0),
        (_answer("unknown", "unknown"), _report("unexplained", "creep"), True, True, True, 1),
    ],
)  # fmt: skip
def test_exact_scores(
    answer: dict[str, Any], report: dict[str, Any], verdict: bool, exact: bool, grouped: bool, false: int
) -> None:
    row = score_exactly(answer, report)
    got = (row["verdict_right"], row["set_right"], row["grouped_right"], row["false_names"])
    assert got == (verdict, exact, grouped, false)


def test_no_interval_is_filtered_out() -> None:
    answer = _answer("single", "dead_time", figures={"delay": [0.004, "s"]})
    for value, ci, holds in ((0.004, [0.003, 0.005], True), (0.4, [0.3, 0.5], False), (0.004, None, False)):
        report = _report("missing_physics", "dead_time")
        report["physics"][0]["parameters"] = {"delay_s": {"value": value, "unit": "s", "ci95": ci}}
        assert [i["covered"] for i in score_exactly(answer, report)["intervals"]] == [holds]


def test_the_calibration_error_is_that_of_a_known_mixture() -> None:
    rng = np.random.default_rng(1)
    honest = [(0.75, float(v)) for v in rng.random(4000) < 0.75]
    boastful = [(0.96, float(v)) for v in rng.random(4000) < 0.66]
    assert reliability(honest)["expected_calibration_error"] == pytest.approx(0.0, abs=0.02)
    assert reliability(boastful)["expected_calibration_error"] == pytest.approx(0.30, abs=0.02)
    assert reliability(honest + boastful)["expected_calibration_error"] == pytest.approx(0.15, abs=0.02)
    assert reliability([])["expected_calibration_error"] is None


def test_summary_counts_false_names_given_something_is_missing() -> None:
    rows = [
        {"case": f"c{i}", "cpu_s": 1.0, **score_exactly(a, r)}
        for i, (a, r) in enumerate(
            [
                (_answer("single", "creep"), _report("missing_physics", "creep", "spikes")),
                (_answer("unknown", "unknown"), _report("missing_physics", "creep")),
                (_answer("agrees"), _report("agrees")),
            ]
        )
    ]
    s = summarise(rows)
    assert s["false_names_given_missing"] == [2, 2]
    assert s["false_names_under_null"] == [0, 1]
    assert s["extra_names"] == [1, 1]
    assert s["wrong_not_flagged"] == [1, 1]
    assert s["by_twin_kind"]["static"]["cases"] == 3


def test_a_run_goes_on_where_it_was_and_its_table_fits(tmp_path: Path) -> None:
    asked: list[Path] = []

    def counting(path: Path) -> dict[str, Any]:
        asked.append(path)
        return silent(path)

    few = Run("develop", 2, 1000)
    first = run_corpus(few, tmp_path, diagnose=counting, progress=lambda text: None)
    again = run_corpus(Run("develop", 3, 1000), tmp_path, diagnose=counting, progress=lambda text: None)
    left_out = first.left_out + again.left_out
    assert len(asked) + left_out >= 3
    assert len(asked) == len(set(asked)), "no case is diagnosed twice"
    assert [r["case"] for r in again.rows][: len(first.rows)] == [r["case"] for r in first.rows]
    none = run_corpus(Run("develop", 5, 1000, minutes=0.0), tmp_path, progress=lambda text: None)
    assert none.open_cases == 2
    assert json.loads(json.dumps(none.to_json()))["open_cases"] == 2
    console = Console(width=80, record=True, file=io.StringIO())
    console.print(corpus_table(again))
    assert max(map(len, console.export_text().splitlines())) <= 80


def test_the_answer_is_not_beside_the_recording(tmp_path: Path) -> None:
    drawn = next(d for n in range(9) if (d := draw_case(CORPORA["develop"], n, tmp_path, 1000)) is not None)
    assert drawn.recording.is_file()
    assert not list(drawn.recording.parent.glob("*.json"))
    assert draw_case(CORPORA["develop"], int(drawn.case[1:]), tmp_path, 1000) == drawn


def test_of_a_sealed_case_scores_are_all_that_is_kept(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    from tools.research.prove import harness

    monkeypatch.setattr(harness, "git_revision", lambda: "0123abc")
    result = run_corpus(Run("sealed", 2, 1000), tmp_path, diagnose=silent, progress=lambda text: None)
    assert result.rows == ()
    assert result.summary["cases"] + result.left_out == 2
    assert not list(tmp_path.rglob("recording.toml"))
    assert "true" not in json.dumps([r.get("true") or None for r in harness.read_rows(next(tmp_path.rglob("*.jsonl")))])
    assert len(harness.read_rows(tmp_path / "sealed-draws.jsonl")) == 1
    monkeypatch.setattr(harness, "git_revision", lambda: "0123abc-dirty")
    with pytest.raises(ValueError, match="commit first"):
        run_corpus(Run("sealed", 1, 1000), tmp_path, diagnose=silent, progress=lambda text: None)
