"""Tables of ``micron reproduce`` as a page of the documentation."""

from __future__ import annotations

import math
from collections.abc import Sequence

from tools.research.reproduce.rows import Row, Table

SIGNS = {"equal": "", "lower": "at most ", "higher": "at least "}
KINDS = {
    "exact": "exact",
    "emulated": "on the emulated device",
    "recording": "on a public recording",
    "not reproducible": "cannot be reproduced",
}


def markdown(tables: Sequence[Table], command: str, revision: str) -> str:
    """Return a section per table: the rows that are not met first, with their reasons, then all of them."""
    lines = ["# Published figures beside ours", "", f"Made by `{command}` at {revision}.", ""]
    for table in tables:
        missed = [row for row in table.rows if not row.meets]
        lines += [f"## {table.name}", "", f"{len(table.rows) - len(missed)} of {len(table.rows)} met.", ""]
        lines += [f"- {_cell(note)}" for note in table.notes]
        if missed:
            lines += ["", "Not met:", ""]
            lines += [
                f"- {_cell(row.quantity)} ({_cell(row.source)}): {_number(row.ours)}, published "
                f"{SIGNS[row.better]}{_number(row.published)} {_cell(row.unit)}; {KINDS[row.kind]}"
                f"{': ' + _cell(row.why) if row.why else ''}"
                for row in missed
            ]
        lines += ["", "| source | quantity | condition | published | ours | unit | obtained | met |"]
        lines += ["|---|---|---|---|---|---|---|---|", *(_line(row) for row in table.rows), ""]
    return "\n".join(lines)


def _line(row: Row) -> str:
    cells = (
        *(_cell(text) for text in (row.source, row.quantity, row.condition)),
        SIGNS[row.better] + _number(row.published),
        _number(row.ours),
        _cell(row.unit),
        KINDS[row.kind],
        "yes" if row.meets else "**no**",
    )
    return f"| {' | '.join(cells)} |"


def _number(value: float) -> str:
    return f"{value:.4g}" if math.isfinite(value) else "-"


def _cell(text: str) -> str:
    return " ".join(text.replace("|", "\\|").replace("<", "&lt;").split())
