"""Words the part of a report that compares several recordings."""

from __future__ import annotations

from tools.mismatch.engine.report import BetweenRecordings, Change, FitSummary, Together
from tools.mismatch.report.wording import chance, number, shown_in

LONGEST_UNIT = 3
"""Largest number of letters behind the last underscore of a condition that are read as its unit."""


def change_text(change: Change) -> str:
    """Return a change as a sentence: ``gain_um_per_V falls by 0.4 % per C of temperature (p = 0.001)``."""
    if change.slope is None:
        text = f"{change.parameter} differs with {change.condition}"
    else:
        way = "falls" if change.slope < 0 else "rises"
        share = f"{number(100 * abs(change.relative))} %" if change.relative is not None else number(abs(change.slope))
        text = f"{change.parameter} {way} by {share} per {step_of(change.condition)}"
    also = f"; {', '.join(change.same)} cannot be told from it" if change.same else ""
    return f"{text} ({chance(change.p_value)}, corrected){also}"


def step_of(condition: str) -> str:
    """Return the unit step of a condition: ``C of temperature`` for ``temperature_C``, else ``1 of order``."""
    name, _, unit = condition.rpartition("_")
    return f"{unit} of {name}" if name and len(unit) <= LONGEST_UNIT else f"1 of {condition}"


def score_rows(together: Together, fit: FitSummary) -> list[tuple[str, str]]:
    """Return the rms on recordings that the fit left out, per output."""
    rows: list[tuple[str, str]] = []
    for o, before in together.rms_recalibrated.items():
        factor, unit = shown_in(fit, o, before)
        after = together.rms_fitted[o]
        text = f"{number(before * factor)} {unit} re-fitted"
        if together.p_value is not None:
            text += f", {number(after * factor)} {unit} with physics ({chance(together.p_value)})"
        rows.append((o, text))
    return rows


def range_text(parameter: BetweenRecordings) -> str:
    """Return the lowest and highest estimate with the unit, and if the parameter was free in each recording."""
    unit = "" if parameter.unit == "1" else f" {parameter.unit}"
    free = ", free in each" if parameter.free else ""
    return f"{min(parameter.values):.4g} to {max(parameter.values):.4g}{unit}{free}"


def change_lines(together: Together) -> list[str]:
    """Return a sentence for each change between recordings, or one that says that none was found."""
    if together.changes:
        return [change_text(c) for c in together.changes]
    if not together.tried:
        return ["too few recordings, or no conditions, to say what changes between them"]
    return [f"no parameter follows a condition ({together.tried} pairs were tried)"]
