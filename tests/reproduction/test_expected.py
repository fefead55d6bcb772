"""Rows of ``micron reproduce`` keep the outcome that ``tools/research/reproduce/expected.json`` pins.

The file says of every row whether it is met. A row that is met for the first time, or no longer, or that is new or gone
is a finding: look at it, then change the file and say why in the commit. The quick part runs with every ``make test``,
whole tables with the slow tests.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path

import pytest

from tools.research.reproduce import endoscope, real_sensors, sensing_static, sensing_variance
from tools.research.reproduce.measured_page import parts_of
from tools.research.reproduce.measured_sets import SETS
from tools.research.reproduce.names import MODULES, reproduce_table
from tools.research.reproduce.recordings import data_folder
from tools.research.reproduce.rows import Row, Table, expected_outcomes, keys
from tools.research.results.artefact import read_page

TABLES = tuple(name for name in MODULES if name != "measured")
"""The diagnoses of ``measured`` take an hour: its pinned outcomes are compared with its artefact."""
MEASURED = Path(__file__).parents[2] / "docs" / "results" / "mismatch-measured.json"


def surprises(table: str, rows: Sequence[Row]) -> list[str]:
    """Return the rows without the expected outcome, in words. Absent rows surprise nobody."""
    pinned = expected_outcomes(table)
    return [
        f"{key}: {'met' if row.meets else 'missed'} ({row.ours:.4g}, published {row.published:.4g}), "
        f"{'not expected' if key in pinned else 'not in expected.json'}"
        for row, key in zip(rows, keys(rows), strict=True)
        if row.meets is not pinned.get(key)
    ]


def unexplained(rows: Sequence[Row]) -> list[str]:
    """Return the rows that are missed without a word on why."""
    return [key for row, key in zip(rows, keys(rows), strict=True) if not (row.meets or row.why)]


def outcomes(page: str) -> dict[str, bool]:
    """Return whether each row of a page that ``document`` made is met, by its key (``keys``)."""
    cells, _ = parts_of(page)
    rows: list[Row] = []
    for s in (s for s in SETS if s.name in cells):
        quantity, ours = f"residual rms, {s.title}", float(cells[s.name][4] or "nan")
        rows += [Row(p.source, quantity, s.unit, "", p.figure, ours, "lower", "recording") for p in s.published]
        if s.goal is not None:
            met = 0.0 if cells[s.name][8] == "yes" else 1.0
            rows.append(Row("goal of the project", quantity, s.unit, "", 0.0, met, "lower", "recording"))
    return {key: row.meets for key, row in zip(keys(rows), rows, strict=True)}


def row(ours: float, quantity: str = "q") -> Row:
    return Row("s", quantity, "1", "c", 1.0, ours, "equal", "exact")


@pytest.fixture
def pinned(monkeypatch: pytest.MonkeyPatch) -> None:
    expected = {"t": {"s: q": True, "s: q (2)": False, "s: other": True}}
    monkeypatch.setattr("tools.research.reproduce.rows.expected_outcomes", lambda name: expected.get(name, {}))
    monkeypatch.setattr(f"{__name__}.expected_outcomes", lambda name: expected.get(name, {}))


@pytest.mark.usefixtures("pinned")
def test_a_row_that_changes_its_outcome_is_named() -> None:
    assert surprises("t", [row(1.0), row(2.0), row(1.0, "other")]) == []
    assert surprises("t", [row(1.0), row(1.0)]) == ["s: q (2): met (1, published 1), not expected"]
    assert surprises("t", [row(3.0)]) == ["s: q: missed (3, published 1), not expected"]
    assert surprises("t", [row(1.0, "new")]) == ["s: new: met (1, published 1), not in expected.json"]


@pytest.mark.usefixtures("pinned")
def test_the_json_says_what_was_expected() -> None:
    rows = Table("t", (row(1.0), row(1.0)), 0.0).as_dict()["rows"]
    assert [(r["meets"], r["expected"]) for r in rows] == [(True, True), (True, False)]
    assert Table("not pinned", (row(1.0),), 0.0).as_dict()["rows"][0]["expected"] is None


def test_rows_of_one_name_are_numbered() -> None:
    assert keys([row(1.0), row(2.0), row(1.0, "other")]) == ["s: q", "s: q (2)", "s: other"]


def test_every_table_is_pinned() -> None:
    assert all(expected_outcomes(name) for name in MODULES)


def test_pinned_outcomes_of_measured_recordings_are_those_of_their_artefact() -> None:
    assert outcomes(read_page(MEASURED)) == expected_outcomes("measured")


QUICK: tuple[tuple[str, Callable[[], Sequence[Row]]], ...] = (
    ("sensing", sensing_variance.placement_tables),
    ("sensing", sensing_variance.table_2_4),
    ("sensing", sensing_static.table_4_1),
    ("endoscope", endoscope.settling),
)
RECORDED: tuple[tuple[str, Callable[[], Sequence[Row]]], ...] = (
    ("real-sensors", real_sensors.xsens),
    ("real-sensors", real_sensors.xsens_gyroscope),
    ("real-sensors", real_sensors.mpu6050),
    ("real-sensors", real_sensors.mpu6050_turn),
    ("real-sensors", real_sensors.adis16405),
    ("real-sensors", real_sensors.qmc5883l),
    ("endoscope", endoscope.broad),
)


@pytest.mark.parametrize(("table", "section"), QUICK)
def test_outcomes_of_documents(table: str, section: Callable[[], Sequence[Row]]) -> None:
    rows = section()
    assert surprises(table, rows) == []
    assert unexplained(rows) == []


@pytest.mark.parametrize(("table", "section"), RECORDED)
def test_outcomes_on_recordings(shared_data: Path, table: str, section: Callable[[], Sequence[Row]]) -> None:
    rows = section()
    assert surprises(table, rows) == []
    assert unexplained(rows) == []


@pytest.mark.slow
@pytest.mark.parametrize("name", TABLES)
def test_outcomes_of_whole_tables(name: str) -> None:
    rows = reproduce_table(name).rows
    assert surprises(name, rows) == []
    assert unexplained(rows) == []
    if data_folder().is_dir():
        gone = set(expected_outcomes(name)) - set(keys(rows))
        assert {key for key in gone if not needs_public_trials(key)} == set()


def needs_public_trials(key: str) -> bool:
    """Return whether a row is one of BROAD trials that are not beside the project (``broad.NOT_GIVEN``)."""
    return key.startswith("BROAD") and ("no setting was chosen with" in key or key.endswith(", one setting"))
