"""The closed loop on the emulated instrument with ideal sensors and actuators, against the bound of its own hand."""

from __future__ import annotations

from pathlib import Path

import pytest

from tools.research.tremor.ideal import GOAL, IdealRow, ideal_run

BENCH = Path(__file__).parents[2] / "benches" / "micron.toml"


@pytest.fixture(scope="module")
def row() -> IdealRow:
    return ideal_run(BENCH, 15.0, noise=True, seed=2)


@pytest.mark.slow
def test_the_ideal_loop_cancels_most_of_the_tremor(row: IdealRow) -> None:
    assert row.reduction_percent > 85.0


@pytest.mark.slow
def test_the_ratio_to_the_bound_is_the_one_that_was_reported(row: IdealRow) -> None:
    """The goal is missed; a run in virtual time is the same everywhere, so a change of what it leaves is seen here."""
    assert row.ratio == pytest.approx(1.288, abs=0.02)


@pytest.mark.slow
@pytest.mark.xfail(reason="1.29 times the bound with the bench's settings against tremor above the band")
def test_the_ideal_loop_is_near_the_bound(row: IdealRow) -> None:
    assert row.ratio < GOAL
