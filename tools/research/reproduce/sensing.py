"""``micron reproduce sensing``: documents Ang 2004 (chapters 2 to 4), Ang 2004b and Latt 2011."""

from __future__ import annotations

from tools.research.reproduce import (
    sensing_budget,
    sensing_dynamic,
    sensing_noise,
    sensing_static,
    sensing_variance,
)
from tools.research.reproduce.rows import Table, build

NOTES = (
    "Ang 2004 Table 4.1 and sec. 4.2.1.2 belong to sensors whose coefficients are not printed, so their figures judge "
    "no row: they stand in the condition of rows that compare ours with an affine fit and with the noise.",
    "Ang 2004 Tables 4.2 and 4.3 are absent from the document (erratum 49).",
)


def table() -> Table:
    """Return the table of all rows."""
    sections = (
        sensing_variance.placement_tables,
        sensing_noise.optimised_placements,
        sensing_variance.table_2_4,
        sensing_static.table_4_1,
        sensing_dynamic.translation_rows,
        sensing_dynamic.arm_rows,
        sensing_dynamic.orientation_rows,
        sensing_budget.rows,
    )
    return build("sensing", sections, NOTES)
