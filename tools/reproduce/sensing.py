"""``micron reproduce sensing``: documents 000 (chapters 2 to 4), 001 and 004."""

from __future__ import annotations

from tools.reproduce import sensing_drift, sensing_noise, sensing_variance
from tools.reproduce.rows import Table, build

NOTES = (
    "Not in this table: Table 4.1, the translation experiment (299.8 -> 20.8 mm/s^2), 004 Fig. 16, the 30 min run.",
)


def table() -> Table:
    """All rows."""
    sections = (
        sensing_variance.placement_tables,
        sensing_noise.optimised_placements,
        sensing_variance.table_2_4,
        sensing_drift.rows,
        sensing_noise.allan_slopes,
    )
    return build("sensing", sections, NOTES)
