"""Prints the measurements of ``micron latency`` as tables of 80 columns: figures like cyclictest's, and a histogram."""

from __future__ import annotations

import math
from collections.abc import Sequence

from rich.table import Table

from tools.diagnose.latency import BEYOND_US, Lateness, octaves

BAR = 4
"""Characters of the longest bar. Bars are logarithmic, because one tick in a million matters."""
EIGHTHS = " ▏▎▍▌▋▊▉█"


def figures_table(measurements: Sequence[Lateness]) -> Table:
    """Return one row per loop: ticks, min, avg, percentiles, max in us, and how many ticks were beyond limits."""
    table = _table(f"Lateness of a 1 ms tick, us; policy {measurements[0].policy}")
    headings = ["loop", "ticks", "min", "avg", "p50", "p99", "p99.9", "max"]
    for heading in [*headings, *(f">{limit_us * 1e-3:g} ms" for limit_us in BEYOND_US)]:
        table.add_column(heading, justify="left" if heading == "loop" else "right", no_wrap=True)
    for one in measurements:
        d = one.histogram.distribution()
        values = (d.min_us, d.mean_us, d.p50_us, d.p99_us, d.p99_9_us, d.max_us)
        beyond = (one.histogram.count_beyond(round(limit_us * 1e3)) for limit_us in BEYOND_US)
        table.add_row(one.what, str(d.n), *(f"{v:.0f}" for v in values), *(str(n) for n in beyond))
    return table


def histogram_table(measurements: Sequence[Lateness]) -> Table:
    """Return the octaves of all loops side by side, with logarithmic bars."""
    table = _table("Ticks by lateness; bars are logarithmic")
    table.add_column("us", justify="right", no_wrap=True)
    for one in measurements:
        table.add_column(one.what, justify="right")
    columns = [dict(octaves(one.histogram)) for one in measurements]
    for bound_us in sorted({bound for column in columns for bound in column}):
        cells = (_cell(column.get(bound_us, 0), sum(column.values())) for column in columns)
        table.add_row(f"<{bound_us:.0f}" if bound_us >= 10 else f"<{bound_us:.1f}", *cells)
    return table


def _table(title: str) -> Table:
    return Table(title=title, title_justify="left", box=None, padding=(0, 1), collapse_padding=True, pad_edge=False)


def _cell(n: int, total: int) -> str:
    """Return the count and its bar, nothing for none."""
    if n == 0:
        return ""
    eighths = max(1, round(8 * BAR * math.log1p(n) / math.log1p(total)))
    return f"{n} {('█' * (eighths // 8) + EIGHTHS[eighths % 8].strip()):<{BAR}}"
