"""``make bench``: every benchmark, one table, ``benchmarks/results.json`` (contracts/commands.md)."""

from __future__ import annotations

import json
import platform
from dataclasses import asdict
from pathlib import Path

from rich.console import Console
from rich.table import Table

from benchmarks import bench_page, latency, mismatch, step, world
from benchmarks.row import Row

RESULTS = Path(__file__).with_name("results.json")


def main() -> None:
    measured: list[Row] = []
    people = Console(stderr=True)
    for module in (step, world, mismatch, latency, bench_page):
        people.print(f"measuring {module.__name__.split('.')[-1]} ...")
        measured.extend(module.rows())
    table = Table(title="Ratios within this run; absolute times are of this machine", title_justify="left")
    for column in ("benchmark", "ours", "peer", "unit", "ratio", "goal", "meets"):
        table.add_column(column, justify="left" if column in ("benchmark", "unit", "goal") else "right")
    for row in measured:
        verdict = "-" if row.meets is None else "yes" if row.meets else "no"
        table.add_row(
            row.name, f"{row.ours:.3g}", f"{row.peer:.3g} ({row.peer_name})", row.unit, f"{row.ratio:.3g}", row.goal,
            verdict,
        )  # fmt: skip
    Console().print(table)
    machine = {"python": platform.python_version(), "machine": platform.machine(), "system": platform.release()}
    RESULTS.write_text(json.dumps({"machine": machine, "rows": [asdict(row) for row in measured]}, indent=2) + "\n")


if __name__ == "__main__":
    main()
