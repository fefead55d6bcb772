"""The terminal report says everything that the contract's JSON holds, and at any width."""

import io
from dataclasses import replace

import pytest
from rich.cells import cell_len
from rich.console import Console

from tests.unit.mismatch_report.canned import all_verdicts, creep, missing_physics, unexplained
from tools.mismatch.batch import Row
from tools.mismatch.report.terminal import batch_report, print_report


def printed(report, width: int = 140) -> str:
    out = io.StringIO()
    print_report(report, Console(file=out, width=width, highlight=False))
    return out.getvalue()


def test_missing_physics_says_what_where_how_much_and_what_next():
    text = printed(missing_physics())
    for said in (
        "Missing physics",
        "amplifier › [actuator] › mechanics",
        "command (recent history 83 %)",
        "1. creep of displacement, at the actuator; sure 97 %",
        "0.0213",
        "0.0190 .. 0.0236",
        "y = x + Σⱼ cⱼ zⱼ",
        "K. Kuhnen, 2003 <eq. 6> & others",
        "0.41 without it, 0.023 with it (um rms, held out)",
        "at the limit of what is searched",
        "leaves 8.3 times the residual of creep",
        "creep = ac coupling: two steps of opposite sign",
        "resonance 0.02 .. dead time 0.4",
        "spikes  none; the longer the record",
        "not white before, white after",
        "p = 1e-09",
        "a state is missing",
        "exact limits in 12 samples",
        "0 to 1.9 s, 3 to 3.9 s",
        "2 to 3 s, 4 to 5 s",
        "Record next",
        "noise_rms in the recording",
        "/data/stack/recording.toml, twin piezo_stack, seed 0, 8.4 s",
    ):
        assert said in text, said


def test_explained_share_is_of_what_stands_above_the_noise():
    # (0.41^2 - 0.023^2) / (0.41^2 - 0.02^2) = 0.99923
    row = next(line for line in printed(missing_physics()).splitlines() if "(spectrum)" in line)
    assert " ".join(row.split()) == "displacement (um) 0.55 0.41 0.023 0.02 (spectrum) 100 %"


def test_names_that_are_not_likely_are_not_said_to_be_missing():
    report = missing_physics()
    doubtful = replace(report, physics=tuple(replace(p, confidence=0.3) for p in report.physics))
    assert "What may be missing: no name is likelier than not" in printed(doubtful)
    assert "What may be missing" not in printed(report)


def test_agrees_lists_every_detection_limit():
    text = printed(all_verdicts()["agrees"])
    assert "resonance 0.02, creep 0.03, backlash 0.05, dead time 0.4" in text
    assert "What is missing" not in text
    assert "Where" not in text


def test_unexplained_keeps_what_was_explained_before():
    text = printed(replace(unexplained(), physics=(creep(),)))
    assert "What explains a part of it" in text
    assert "[mechanics]" in text
    assert "[actuator]" in text
    assert "the same path of command at three speeds" in text


def test_a_linear_effect_beside_columns_that_leaves_only_noise_is_not_called_a_rest():
    """Only a wrong parameter of the simulation behind the columns is a rival: the report says that, and no more."""
    summary = (
        "What creep explains of displacement may also be a wrong parameter of the simulation that made the columns."
    )
    explained = replace(
        missing_physics(), verdict="unexplained", meaning="place_not_reachable", twin="columns", summary=summary
    )
    text = " ".join(printed(explained).split())
    assert "account for all of it down to the noise" in text
    assert "What would explain it" in text
    assert "is left" not in text
    rest = replace(explained, fit=replace(explained.fit, fitted_rms=explained.fit.recalibrated_rms))
    text = " ".join(printed(rest).split())
    assert "what is left may sit between them" in text
    assert "What explains a part of it" in text


def test_a_probability_that_two_names_share_names_the_other():
    found = missing_physics()
    halved = replace(found, physics=(replace(creep(), confidence=0.51),))
    assert "sure 51 %, a probability shared with ac coupling, which fits as well" in printed(halved)
    assert "shared" not in printed(found), "at 97 % the other has no share that matters"
    assert "shared" not in printed(replace(halved, equivalent=()))


@pytest.mark.parametrize("width", [60, 80, 200])
@pytest.mark.parametrize("verdict", ["agrees", "recalibrate", "missing_physics", "unexplained"])
def test_every_width_is_kept(width: int, verdict: str):
    assert max(map(cell_len, printed(all_verdicts()[verdict], width).splitlines())) <= width


def test_brackets_in_names_are_text_and_not_markup():
    r = missing_physics()
    found = replace(creep(), source="[bold]x[/] [eq. 3]", note="[red]")
    assert "[bold]x[/] [eq. 3]" in printed(replace(r, physics=(found,), summary="Left in [a/b]."))


def test_a_folder_is_one_table():
    good = Row("a", "/x/a", missing_physics().to_json())
    bad = Row("b [1]", "/x/b", error="b.toml: no [twin] with a 'kind'", bad_input=True)
    out = io.StringIO()
    Console(file=out, width=160, highlight=False).print(batch_report([good.cells, bad.cells]))
    lines = out.getvalue().splitlines()
    assert " ".join(lines[1].split()) == "a missing physics creep displacement (um) 0.41 0.023 0.02 8"
    assert lines[3:] == ["Without a report", "b [1]: b.toml: no [twin] with a 'kind'"]


def test_a_folder_on_eighty_columns_keeps_its_figures_whole():
    row = Row("long-name", "/x/a", missing_physics().to_json()).cells
    figures = {"recalibrated": "0.00992", "fitted": "0.00431", "noise": "0.00426", "seconds": "12"}
    out = io.StringIO()
    Console(file=out, width=80, highlight=False).print(batch_report([{**row, "physics": "first order lag", **figures}]))
    text = out.getvalue()
    assert all(f" {value} " in text for value in figures.values())
    assert "first order" in text
