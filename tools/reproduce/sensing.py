"""``micron reproduce sensing``: documents 000 (chapters 2 to 4), 001 and 004."""

from __future__ import annotations

from tools.reproduce import sensing_drift, sensing_variance
from tools.reproduce.rows import Table, build


def table() -> Table:
    """All rows."""
    return build("sensing", (sensing_variance.placement_tables, sensing_variance.table_2_4, sensing_drift.rows))
