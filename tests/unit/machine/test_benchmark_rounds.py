"""Rounds of a benchmark become one row each, and the command line of ``python -m benchmarks`` refuses what it must."""

from __future__ import annotations

from dataclasses import replace

import pytest

from benchmarks.__main__ import median_rows, parse
from benchmarks.row import Row

ROW = Row("p50", "one run", 30.0, 20.0, "bare loop", "us", 1.5, "<= 2 x", meets=True, must=True, why="the host")


def test_a_row_has_medians_and_says_how_often_its_goal_was_met():
    slow = replace(ROW, ours=90.0, peer=30.0, ratio=3.0, meets=False)
    rounds = [[ROW], [slow], [replace(ROW, ours=10.0, peer=10.0, ratio=1.0), replace(ROW, name="p99")]]
    p50, p99 = median_rows(rounds)
    assert (p50.ours, p50.peer, p50.ratio, p50.meets, p50.why) == (30.0, 20.0, 1.5, True, "")
    assert p50.what == "3 rounds, ratio 1 to 3, goal met in 2"
    assert p99 == replace(ROW, name="p99")


def test_a_goal_that_half_of_the_rounds_meet_is_not_met():
    (row,) = median_rows([[ROW], [replace(ROW, meets=False)]])
    assert row.meets is False
    assert row.why == "the host"


@pytest.mark.parametrize(("words", "says"), [(["nothing"], "nothing"), (["step", "--rounds", "0"], "at least 1 round")])
def test_what_cannot_be_measured_is_one_message(words: list[str], says: str, capsys: pytest.CaptureFixture[str]):
    with pytest.raises(SystemExit) as error:
        parse(words)
    assert error.value.code == 2
    assert says in capsys.readouterr().err
