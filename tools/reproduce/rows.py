"""One published figure beside ours. ``meets`` is computed from the two, never typed."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, field
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
        """Whether ours is the published figure (``equal``) or at least as good; a figure that is missing never is."""
        if not (math.isfinite(self.published) and math.isfinite(self.ours)):
            return False
        if self.better == "equal":
            return abs(self.ours - self.published) <= self.tolerance * (1.0 + 1e-9)
        if self.better == "lower":
            return self.ours <= self.published
        return self.ours >= self.published

    def as_dict(self) -> dict[str, Any]:
        """The row of contracts/commands.md."""
        return {**asdict(self), "meets": self.meets}


@dataclass(frozen=True)
class Table:
    """What ``micron reproduce NAME`` prints; ``notes`` are conditions that hold for all rows, or what was skipped."""

    name: str
    rows: tuple[Row, ...]
    seconds: float
    notes: tuple[str, ...] = field(default=())
    page: str = ""
    """A page of the table's own, where it has one."""

    def as_dict(self) -> dict[str, Any]:
        return {
            "format": 1,
            "name": self.name,
            "seconds": self.seconds,
            "rows": [row.as_dict() for row in self.rows],
            "notes": list(self.notes),
        }


Section = Callable[[], Sequence[Row]]


def build(name: str, sections: Sequence[Section], notes: Sequence[str] = ()) -> Table:
    """Run every section and put its rows into one table."""
    start = time.perf_counter()
    rows = tuple(row for section in sections for row in section())
    return Table(name, rows, time.perf_counter() - start, tuple(notes))
