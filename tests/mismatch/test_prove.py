"""The proof's machinery: seal, scoring, tables; and one small real run."""

from __future__ import annotations

import io
import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
from rich.console import Console

from tools.interrupt import begin_command, is_stopped
from tools.research.prove import draw, page, prove, seal
from tools.research.prove.nulls import clopper_pearson, document, kept, nulls
from tools.research.prove.score import coverage, score
from tools.research.prove.table import failures, show

QUIET = {"max_samples": 2500, "progress": lambda text: None}


def silent(path: Path) -> dict[str, Any]:
    """Says that everything agrees."""
    del path
    return {"format": 1, "verdict": "agrees", "physics": [], "location": {}, "fit": {}, "seconds": 0.0}


def peeking(path: Path) -> dict[str, Any]:
    """A perfect tool: opens the seal beside the recordings. Only for tests of the scoring."""
    answers = json.loads((path.parents[2] / "sealed" / "answers.json").read_text())
    a = answers[path.parent.name]
    outs = list(a["noise_rms"])
    first = a["effects"][0] if a["effects"] else None
    verdict = {"single": "missing_physics", "pair": "missing_physics", "unknown": "unexplained"}.get(
        a["kind"], a["kind"]
    )
    physics = [
        {"name": t["name"], "parameters": {}, "output": t["outputs"][0]} for t in a["effects"] if t["name"] != "unknown"
    ]
    rms = {k: a["noise_rms"][k] for k in outs}
    return {
        "format": 1,
        "verdict": verdict,
        "physics": physics,
        "location": {
            "outputs": first["outputs"] if first else [],
            "stage": first["stages"][0] if first else "",
            "depends_on": [{"signal": first["depends"][0], "feature": "value", "strength": 1.0}] if first else [],
        },
        "fit": {"unit": {}, "fitted_rms": rms, "recalibrated_rms": {k: 5 * v for k, v in rms.items()}},
        "seconds": 0.0,
    }


def test_a_perfect_tool_scores_full_marks_and_a_silent_one_none(tmp_path: Path) -> None:
    good = prove(12, 21, 1, tmp_path / "good", diagnose=peeking, **QUIET)
    s = good.summary
    for key in ("named_severity_4_up", "named_severity_2", "pairs_both_named", "unknown_with_right_signal"):
        assert s[key][0] == s[key][1]
    assert s["false_alarms"][0] == s["below_noise"][0] == s["errors"][0] == 0
    assert failures(good.rows) == []
    bad = prove(12, 21, 1, tmp_path / "bad", diagnose=silent, **QUIET)
    assert bad.summary["named_severity_4_up"][0] == 0
    assert bad.summary["false_alarms"][0] == 0
    assert bad.digest == good.digest
    text = io.StringIO()
    show(bad, Console(file=text, width=140))
    assert "weak classes" in text.getvalue()
    proofs = [tmp_path / "good.json", tmp_path / "bad.json"]
    for file, result in zip(proofs, (good, bad), strict=True):
        file.write_text(json.dumps(result.to_json()))
    text = page.document([page.read(file) for file in proofs])
    assert "24 cases" in text
    assert text.count(good.digest) == 2
    n = good.summary["named_severity_4_up"][1]
    assert f"severity 4 and above | {n} of {2 * n} | 50 %" in text
    assert text.count("- WRONG") == len(failures(bad.rows))


def test_the_hash_is_said_before_any_diagnosis_and_a_broken_seal_is_noticed(tmp_path: Path) -> None:
    said: list[str] = []

    def tamper(path: Path) -> dict[str, Any]:
        assert any("sha256" in line for line in said)
        file = path.parents[2] / "sealed" / "answers.json"
        file.write_text(file.read_text() + " ")
        return silent(path)

    with pytest.raises(ValueError, match="sealed"):
        prove(2, 5, 1, tmp_path, diagnose=tamper, max_samples=2500, progress=said.append)


def test_an_interrupted_proof_goes_on_in_its_folder(tmp_path: Path) -> None:
    asked: list[str] = []

    def second_breaks(path: Path) -> dict[str, Any]:
        asked.append(path.parent.name)
        if len(asked) == 2:
            raise KeyboardInterrupt
        return silent(path)

    plans = [draw.Plan("agrees", "piezo_stack", (), 2.0)] * 3
    more = {"plans": plans, "seed": 4, "jobs": 1, "diagnose": second_breaks, **QUIET}
    with begin_command():
        assert len(prove(folder=tmp_path, **more).rows) == 1, "Ctrl-C keeps what was scored"
        assert is_stopped()
    assert not is_stopped()
    assert len(prove(folder=tmp_path, **more).rows) == 3
    assert asked == ["r000", "r001", "r001", "r002"]


def test_a_crash_of_the_tool_is_counted(tmp_path: Path) -> None:
    def broken(path: Path) -> dict[str, Any]:
        raise RuntimeError(str(path))

    r = prove(3, 6, 1, tmp_path, diagnose=broken, **QUIET)
    assert r.summary["errors"] == [len(r.rows), len(r.rows)]


def _answer(**more: Any) -> dict[str, Any]:
    effect = {
        "name": "dead_time", "form": "f", "outputs": ["displacement"], "stages": ["amplifier"], "depends": ["command"],
        "predictable": True, "figures": {"delay": [0.004, "s"]},
    }  # fmt: skip
    return {
        "kind": "single", "twin": "piezo_stack", "severity": 4.0, "excitation": "chirp", "effects": [effect],
        "noise_kind": "white", "noise_rms": {"displacement": 0.1}, "decoys": [], **more,
    }  # fmt: skip


def test_scoring_reads_units_intervals_and_order() -> None:
    par = {"delay_ms": {"value": 4.1, "unit": "ms", "ci95": [3.9, 4.3]}}
    report = {
        "verdict": "missing_physics",
        "physics": [{"name": "dead_time", "parameters": par}, {"name": "creep", "parameters": {}}],
        "location": {"outputs": ["displacement"], "stage": "amplifier", "depends_on": [{"signal": "command"}]},
        "fit": {"unit": {"displacement": "m"}, "recalibrated_rms": {"displacement": 0.41e-6},
                "fitted_rms": {"displacement": 0.08e-6}},
    }  # fmt: skip
    row = score(_answer(), report)
    assert row["ok"]
    assert row["extra"] == ["creep"]
    assert row["below_noise"]
    assert row["ratio"] == pytest.approx(0.8)
    assert [c["covered"] for c in coverage(report, _answer())] == [True]
    report["physics"].reverse()
    assert not score(_answer(), report)["ok"]
    par["delay_ms"]["unit"] = "um"  # a figure of another dimension is none of the answer's
    assert coverage(report, _answer(), far_off=True) == []


def test_null_harness_counts_and_bounds() -> None:
    r = nulls(6, 3, 1, max_samples=1500, diagnose=silent, say=lambda text: None)
    assert r.count() == (0, 6)
    assert "0 of 6 (0.0 to 45.9 %)" in document(r)
    assert clopper_pearson(0, 300)[1] == pytest.approx(0.0122, abs=1e-4)  # 1 - 0.025**(1/300)


def test_an_interrupted_null_run_ends_as_an_uninterrupted_one(tmp_path: Path) -> None:
    rows = tmp_path / "rows.json"
    more = {"max_samples": 1500, "diagnose": silent, "say": lambda text: None}
    nulls(2, 3, 1, rows_file=rows, **more)
    continued = nulls(4, None, 1, rows_file=rows, **more)
    whole = nulls(4, 3, 1, **more)
    drawn = [[{k: v for k, v in row.items() if k != "seconds"} for row in r.rows] for r in (continued, whole)]
    assert drawn[0] == drawn[1]
    assert [row["index"] for row in continued.rows] == [0, 1, 2, 3]
    assert kept(rows).rows == continued.rows
    with pytest.raises(ValueError, match="made with seed 3, not 9"):
        nulls(4, 9, 1, rows_file=rows, **more)


def test_a_page_of_null_runs_keeps_what_it_said_of_earlier_states() -> None:
    run = nulls(2, 3, 1, max_samples=1500, diagnose=silent, say=lambda text: None)
    first, second, third = (replace(run, revision=10 * letter, seed=k) for k, letter in enumerate("abc"))
    page = document(third, document(second, document(first)))
    row = "0 of 2 (0.0 to 84.2 %)"
    assert f"| aaaaaaaaaa | 0 | {row} |\n| bbbbbbbbbb | 1 | {row} |\n" in page
    assert f"- false alarms: {row}" in page  # the earlier ones are not counted in
    assert document(third, page) == page


def test_sealed_answers_come_back(tmp_path: Path) -> None:
    digest = seal.close({"r0": {"kind": "agrees"}}, tmp_path)
    assert seal.opened(tmp_path, digest) == {"r0": {"kind": "agrees"}}


@pytest.mark.slow
def test_small_real_proof(tmp_path: Path) -> None:
    """One case of each kind through the real tool: what is plain is named, controls raise no alarm."""
    plans = (
        draw.Plan("single", "piezo_stack", ("backlash",), 10.0),
        draw.Plan("single", "accelerometer", ("misalignment",), 10.0),
        draw.Plan("pair", "piezo_stack", ("saturation", "mains_interference"), 10.0),
        draw.Plan("agrees", "accelerometer_cluster", (), 4.0),
        draw.Plan("recalibrate", "state_space", (), 10.0),
        draw.Plan("unknown", "piezo_stack", (), 30.0),
    )
    s = prove(seed=1, jobs=1, folder=tmp_path, plans=plans, max_samples=2500, progress=lambda text: None).summary
    assert s["cases"] == 6
    assert s["errors"][0] == s["false_alarms"][0] == s["below_noise"][0] == 0
    # the effect outside the vocabulary runs unjudged: today this one is taken for a step shift (seed 1, case 5)
    for measure in ("named_severity_4_up", "pairs_both_named", "controls_verdict_right"):
        assert s[measure][0] == s[measure][1] > 0, measure


def test_the_page_says_what_a_stopped_run_left_out() -> None:
    proof = {"cases": [{}] * 3, "asked": 9}
    assert page._count(proof) == "the first 3 of 9"
    assert page._count({**proof, "left_out": ["r001 (an FMU)"]}) == "the first 4 of 9 without r001 (an FMU)"
    assert page._count({"cases": [{}] * 3}) == "3"
