"""The exact scores of a run over a corpus, for people: at most 80 columns."""

from __future__ import annotations

from collections.abc import Mapping
from types import MappingProxyType
from typing import Any

from rich.console import Group, RenderableType
from rich.table import Table

from tools.research.prove.harness import Result
from tools.research.prove.nulls import clopper_pearson

LINES = MappingProxyType(
    {
        "verdict_right": "verdict right",
        "first_right": "first name right",
        "set_right_single": "single effects: set of names right",
        "set_right_pair": "pairs: set of names right",
        "grouped_right": "... up to stated equivalences",
        "unknown_unexplained": "out of vocabulary: 'unexplained'",
        "null_right": "nothing missing: verdict right",
        "extra_names": "reports with a name too many",
        "wrong_not_flagged": "wrong sets without 'unexplained'",
        "false_names_given_missing": "false names per report, something missing",
        "false_names_under_null": "false names per report, nothing missing",
        "intervals_hold": "95 % intervals that hold",
        "errors": "crashed or refused",
    }
)
"""Scores and how they are called."""
APART = ("set_right_single", "set_right_pair", "grouped_right", "unknown_unexplained", "null_right")


def share_text(got: float, of: float) -> str:
    """A share with its exact 95 % interval; "" of nothing, and the mean alone where counts may exceed the number."""
    if not of:
        return ""
    if got > of:
        return f"{got / of:.2f}"
    low, high = clopper_pearson(int(got), int(of))
    return f"{100 * got / of:.0f} % ({100 * low:.0f}-{100 * high:.0f})"


def corpus_table(result: Result) -> RenderableType:
    """Scores, the reliability diagram, and kinds of twin apart."""
    s, run = result.summary, result.run
    totals = Table(title=f"Corpus {run.corpus}", title_justify="left")
    for name in ("score", "count", "share (95 %)"):
        totals.add_column(name, justify="left" if name == "score" else "right")
    for key, text in LINES.items():
        got, of = s[key]
        totals.add_row(text, f"{got}/{of}", share_text(got, of))
    apart = Table(title="By kind of twin", title_justify="left")
    apart.add_column("twin")
    for name in ("singles", "pairs", "grouped", "unknown", "null", "CPU s"):
        apart.add_column(name, justify="right")
    for kind, figures in s["by_twin_kind"].items():
        apart.add_row(kind, *(_cell(figures, key) for key in APART), f"{figures['cpu_s']['total']:.0f}")
    diagram = Table(title="How sure, and how often right", title_justify="left")
    for name in ("stated", "mean stated", "right", "names"):
        diagram.add_column(name, justify="right")
    for low, high, stated, right, count in s["reliability"]["bins"]:
        diagram.add_row(f"{low:.2f}-{high:.2f}", f"{stated:.3f}", f"{right:.3f}", f"{count:.0f}")
    error = s["reliability"]["expected_calibration_error"]
    text = "none named" if error is None else f"expected calibration error {error:.3f}"
    cpu = s["cpu_s"]
    foot = (
        f"{s['cases']} cases of at most {run.max_samples} samples; {text}; CPU {cpu['total']:.0f} s,"
        f" median {cpu['median'] or 0:.1f} s, longest {cpu['longest'] or 0:.1f} s"
    )
    if result.left_out:
        foot += f"\n{result.left_out} cases could not be drawn (an FMU without the extra 'fmu', or no scene shows it)"
    if result.open_cases:
        foot += f"\n{result.open_cases} cases are still to be done; run the same command again"
    return Group(totals, diagram, apart, foot)


def _cell(figures: Mapping[str, Any], key: str) -> str:
    got, of = figures[key]
    return f"{got}/{of}" if of else ""
