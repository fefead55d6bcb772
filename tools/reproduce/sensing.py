"""``micron reproduce sensing``: documents 000 (chapters 2 to 4), 001 and 004."""

from __future__ import annotations

from tools.reproduce import (
    sensing_budget,
    sensing_drift,
    sensing_dynamic,
    sensing_noise,
    sensing_static,
    sensing_variance,
)
from tools.reproduce.rows import Table, build

NOTES = (
    "How far the physical model reduces the errors of emulated sensors depends on how much of them has its form: "
    "that share is ours to choose (tools/reproduce/sensing_static.py), the published one belongs to real sensors.",
    "000 Tables 4.2 and 4.3 are absent from the document (ERRATA 49).",
)


def table() -> Table:
    """All rows."""
    sections = (
        sensing_variance.placement_tables,
        sensing_noise.optimised_placements,
        sensing_variance.table_2_4,
        sensing_drift.rows,
        sensing_noise.allan_slopes,
        sensing_static.table_4_1,
        sensing_dynamic.translation_rows,
        sensing_dynamic.arm_rows,
        sensing_dynamic.orientation_rows,
        sensing_budget.rows,
    )
    return build("sensing", sections, NOTES)
