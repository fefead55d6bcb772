"""Compares the result of a measured set with its published rows, and describes the rest in words."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any

from tools.research.reproduce.measured_sets import SETS
from tools.research.reproduce.rows import Row


@dataclass(frozen=True)
class MeasuredRow(Row):
    """A published figure or goal beside ours; ``named``: what the engine said, ``cpu_s`` of the diagnosis."""

    set: str = ""
    verdict: str = ""
    named: tuple[str, ...] = ()
    names_meet: bool | None = None
    cpu_s: float = 0.0
    revision: str = ""


@dataclass(frozen=True)
class Scored:
    """Holds the result of a set: the report on the fit part, and the residual rms on the sealed test in its unit.

    ``left``: what the corrected twin's residual on the test follows, (signal, feature, share of variance).
    """

    name: str
    report: Mapping[str, Any]
    given: float | None
    refitted: float | None
    corrected: float | None
    floor: float | None
    left: tuple[tuple[str, str, float], ...]
    cpu_s: float
    revision: str
    error: str = ""

    @property
    def named(self) -> tuple[str, ...]:
        """Effects in the order in which they were accepted."""
        return tuple(str(p["name"]) for p in self.report.get("physics", ()))

    @property
    def verdict(self) -> str:
        """Return what the engine said of the fit part, or that it failed."""
        return "error" if self.error else str(self.report.get("verdict", "error"))


def rows_of(done: Scored) -> list[Row]:
    """A row per published figure, and one for the goal."""
    s = next(one for one in SETS if one.name == done.name)
    why = done.error or explained(done)
    ours = float("nan") if done.corrected is None else done.corrected
    common: dict[str, Any] = {
        "unit": s.unit, "better": "lower", "kind": "recording", "set": s.name, "verdict": done.verdict,
        "named": done.named, "cpu_s": round(done.cpu_s, 1), "revision": done.revision,
    }  # fmt: skip
    where = "held-out blocks" if s.test is None else "sealed official test"
    rows: list[Row] = []
    for p in s.published:
        row = MeasuredRow(p.source, f"residual rms, {s.title}", condition=f"{where}; against {p.what}",
                          published=p.figure, ours=ours, **common)  # fmt: skip
        rows.append(row if row.meets else replace(row, why=why))
    if s.goal is not None:
        meet = s.goal.names_meet(list(done.named))
        goal = s.goal.figure * (done.given or float("nan")) if s.goal.relative_to_given else s.goal.figure
        row = MeasuredRow("goal of the project", f"residual rms, {s.title}", condition=f"{where}; with the right names",
                          published=goal, ours=ours if meet else float("nan"), names_meet=meet, **common)  # fmt: skip
        verdict = f"named {', '.join(done.named) or 'nothing'}" if not meet else ""
        rows.append(row if row.meets else replace(row, why="; ".join(w for w in (verdict, why) if w)))
    return rows


def explained(done: Scored) -> str:
    """Return what is left on the test, by the engine's own analysis."""
    if not done.left:
        return "what is left on the test follows nothing that was recorded"
    return "what is left on the test follows " + ", ".join(f"{a} ({b}: {100 * c:.0f} %)" for a, b, c in done.left)
