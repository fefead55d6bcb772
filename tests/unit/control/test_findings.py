"""The table of findings: nothing is reported that is not in it, no message lacks a word, and its page is current."""

from __future__ import annotations

import ast
import string
from pathlib import Path

import pytest

from firmware_py.run import findings
from firmware_py.run.findings import (
    CauseClass,
    Finding,
    classify_button_error,
    classify_output_error,
    classify_scan_error,
)
from hal.errors import (
    BusError,
    Disconnected,
    ErrorKind,
    HalError,
    HalTimeout,
    I2cNack,
    LeaseLost,
    Overrun,
    ProtocolError,
    SafetyTrip,
)
from tools.research.reports.findings_page import markdown

ROOT = Path(__file__).parents[3]
REPORTS = {"report": 1, "report_reading": 1, "report_error": 3, "report_after": 4}
"""Ways of Incidents to a consequence, with the number of their own arguments."""
INSIDE = {Finding.TOO_MANY_HOLDS, Finding.HOLD_TOO_LONG, Finding.NEUTRAL_NOT_REACHED}
"""Findings that Incidents and the supervisor make of others."""


def reports() -> list[tuple[str, ast.Call]]:
    """Every call of an ``Incidents`` in the firmware that has a consequence, with where it is."""
    found: list[tuple[str, ast.Call]] = []
    for path in sorted((ROOT / "firmware_py").rglob("*.py")):
        if path.name == "incidents.py":
            continue
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            if isinstance(node, ast.Call) and isinstance(node.func, ast.Attribute) and node.func.attr in REPORTS:
                owner = ast.unparse(node.func.value)
                if owner.endswith("incidents"):
                    found.append((f"{path.name}:{node.lineno}", node))
    return found


def findings_of(call: ast.Call) -> list[Finding]:
    """What a call may report: a row by name, or what a function of the table chooses."""
    first = call.args[0]
    if isinstance(first, ast.Attribute) and ast.unparse(first.value) == "Finding":
        return [Finding[first.attr]]
    chooser = (
        first.func.id if isinstance(first, ast.Call) and isinstance(first.func, ast.Name) else "classify_scan_error"
    )
    source = ast.parse(Path(findings.__file__).read_text(encoding="utf-8"))
    function = next(n for n in source.body if isinstance(n, ast.FunctionDef) and n.name == chooser)
    return [
        Finding[n.attr]
        for n in ast.walk(function)
        if isinstance(n, ast.Attribute) and ast.unparse(n.value) == "Finding"
    ]


def words_of(finding: Finding) -> set[str]:
    return {name for _, name, _, _ in string.Formatter().parse(finding.value.says) if name}


def test_every_report_names_findings_of_the_table_and_gives_all_their_words():
    calls = reports()
    assert len(calls) > 20
    for where, call in calls:
        assert isinstance(call.func, ast.Attribute)
        given = {keyword.arg for keyword in call.keywords}
        if call.func.attr == "report_error":
            given.add("error")
        assert len(call.args) == REPORTS[call.func.attr], where
        for finding in findings_of(call):
            assert words_of(finding) <= given, f"{where}: {finding} lacks {words_of(finding) - given}"


def test_every_finding_is_reported_somewhere():
    reported = {finding for _, call in reports() for finding in findings_of(call)}
    assert reported | INSIDE == set(Finding)
    assert not reported & INSIDE


def test_a_finding_has_a_title_of_its_own_and_a_reason():
    titles = [finding.value.title for finding in Finding]
    assert len(set(titles)) == len(titles)
    for finding in Finding:
        assert finding.value.why.endswith(".")
        assert not (finding.value.normal and finding.value.recoverable)


def test_what_a_person_wants_is_never_recoverable():
    assert not [f for f in Finding if f.value.cause is CauseClass.OPERATOR and f.value.recoverable]


@pytest.mark.parametrize(
    ("error", "finding"),
    [
        (Disconnected("gone"), Finding.DAQ_GONE),
        (Overrun("full"), Finding.DAQ_OVERFLOW),
        (BusError("noise"), Finding.DAQ_TRANSFER),
        (HalTimeout("late"), Finding.DAQ_TRANSFER),
        (ProtocolError("lost bytes", kind=ErrorKind.FRAMING), Finding.DAQ_TRANSFER),
        (ProtocolError("nonsense"), Finding.DAQ_FAILED),
        (HalError("?"), Finding.DAQ_FAILED),
    ],
)
def test_what_an_error_of_reading_scans_means(error: HalError, finding: Finding):
    assert classify_scan_error(error, 0.0) is finding


def test_an_overflow_while_the_host_stood_still_is_the_hosts():
    assert classify_scan_error(Overrun("full"), 200.0) is Finding.DAQ_OVERFLOW_BY_HOST


@pytest.mark.parametrize(
    ("error", "finding"),
    [
        (I2cNack("refused"), Finding.OUTPUT_TRANSFER),
        (HalTimeout("late"), Finding.OUTPUT_TRANSFER),
        (LeaseLost("late"), Finding.LEASE_LOST),
        (SafetyTrip("nan"), Finding.OUTPUT_FAILED),
        (ProtocolError("holds something else"), Finding.OUTPUT_FAILED),
        (Disconnected("gone"), Finding.OUTPUT_FAILED),
    ],
)
def test_what_an_error_of_the_outputs_means(error: HalError, finding: Finding):
    assert classify_output_error(error) is finding


def test_what_an_error_of_the_buttons_bus_means():
    assert classify_button_error(Disconnected("gone")) is Finding.BUTTON_GONE
    assert classify_button_error(BusError("bus-off")) is Finding.BUTTON_BUS


def test_the_page_is_current():
    page = (ROOT / "docs" / "findings.md").read_text(encoding="utf-8")
    assert page == markdown(), "python -m tools.research.reports.findings_page docs/findings.md"
