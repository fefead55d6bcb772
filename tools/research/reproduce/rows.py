"""Compares published figures with ours. ``meets`` is computed from both, never typed."""

from __future__ import annotations

import json
import math
import time
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any, Literal

Better = Literal["equal", "lower", "higher"]
Kind = Literal["exact", "emulated", "recording", "not reproducible"]


@dataclass(frozen=True)
class Row:
    """``tolerance``: for ``equal``, how far ours may be off, in ``unit``, because of the digits that were printed."""

    source: str
    quantity: str
    unit: str
    condition: str
    published: float
    ours: float
    better: Better
    kind: Kind
    tolerance: float = 0.0
    why: str = ""

    @property
    def meets(self) -> bool:
        """Return True if ours equals the published figure (``equal``) or is as good; False if one is missing."""
        if not (math.isfinite(self.published) and math.isfinite(self.ours)):
            return False
        if self.better == "equal":
            return abs(self.ours - self.published) <= self.tolerance * (1.0 + 1e-9)
        if self.better == "lower":
            return self.ours <= self.published
        return self.ours >= self.published

    def as_dict(self) -> dict[str, Any]:
        """JSON values of the row itself; ``Table.as_dict`` adds the outcome that is expected."""
        return {**asdict(self), "meets": self.meets}


@dataclass(frozen=True)
class Table:
    """Holds the output of ``micron reproduce NAME``; ``notes`` are conditions of all rows, or omissions."""

    name: str
    rows: tuple[Row, ...]
    seconds: float
    notes: tuple[str, ...] = field(default=())
    page: str = ""
    """A page of the table's own, where it has one."""

    def as_dict(self) -> dict[str, Any]:
        pinned = expected_outcomes(self.name)
        rows = [
            {**row.as_dict(), "expected": pinned.get(key)} for row, key in zip(self.rows, keys(self.rows), strict=True)
        ]
        return {"format": 1, "name": self.name, "seconds": self.seconds, "rows": rows, "notes": list(self.notes)}


def keys(rows: Sequence[Row]) -> list[str]:
    """Return the key of each row in its table: source and quantity, and a number if both occur again."""
    found: list[str] = []
    count: dict[str, int] = {}
    for row in rows:
        name = f"{row.source}: {row.quantity}"
        count[name] = count.get(name, 0) + 1
        found.append(name if count[name] == 1 else f"{name} ({count[name]})")
    return found


def expected_outcomes(table: str) -> dict[str, bool]:
    """Return the outcome that is expected of each row of a table, by its key (``expected.json``); True is met.

    Empty for an unknown table.
    """
    text = Path(__file__).with_name("expected.json").read_text(encoding="utf-8")
    expected: dict[str, dict[str, bool]] = json.loads(text)
    return expected.get(table, {})


Section = Callable[[], Sequence[Row]]


def build(name: str, sections: Sequence[Section], notes: Sequence[str] = ()) -> Table:
    """Run every section and put its rows into one table."""
    start = time.perf_counter()
    rows = tuple(row for section in sections for row in section())
    return Table(name, rows, time.perf_counter() - start, tuple(notes))
