"""``make bench [ONLY="step world"]``: every benchmark, one table, ``results.json`` (contracts/commands.md)."""

from __future__ import annotations

import importlib
import json
import math
import os
import platform
import sys
from dataclasses import asdict
from pathlib import Path

from rich.console import Console
from rich.table import Table

from benchmarks.row import Row

RESULTS = Path(__file__).with_name("results.json")
MODULES = (
    "step", "latency", "world", "attitude", "noise", "hysteresis", "mismatch", "recorder", "loop", "memory", "start",
)  # fmt: skip


def number(value: float) -> str:
    return "-" if not math.isfinite(value) else f"{value:.3g}"


def whole_table(rows: list[Row]) -> Table:
    """Everything that was measured."""
    table = Table(title="Ratios within this run; absolute figures are of this machine", title_justify="left")
    for column in ("benchmark", "ours", "peer", "unit", "ratio", "what"):
        table.add_column(column, justify="right" if column in ("ours", "ratio") else "left", overflow="fold")
    for row in rows:
        peer = f"{number(row.peer)} ({row.peer_name})"
        table.add_row(row.name, number(row.ours), peer, row.unit, number(row.ratio), row.what)
    return table


def must_table(rows: list[Row]) -> Table:
    """What it must reach: met, not met and why."""
    table = Table(title="What it must reach", title_justify="left")
    for column in ("figure", "goal", "found", "met", "why not"):
        table.add_column(column, overflow="fold")
    for row in rows:
        if row.must:
            met = "not measured" if row.meets is None else "met" if row.meets else "NOT met"
            found = f"{number(row.ours)} {row.unit}, ratio {number(row.ratio)} to {row.peer_name}"
            table.add_row(row.name, row.goal, found, met, row.why if not row.meets else "")
    return table


def plain(row: Row) -> dict[str, object]:
    """JSON has no nan."""
    table = asdict(row)
    return {k: None if isinstance(v, float) and not math.isfinite(v) else v for k, v in table.items()}


def main(chosen: list[str]) -> int:
    people = Console(stderr=True)
    unknown = sorted(set(chosen) - set(MODULES))
    if unknown:
        people.print(f"no benchmark {', '.join(unknown)}; there are {', '.join(MODULES)}")
        return 2
    os.environ.setdefault("OMP_NUM_THREADS", "1")
    measured: list[Row] = []
    failed = []
    for name in MODULES:
        if chosen and name not in chosen:
            continue
        people.print(f"measuring {name} ...")
        try:
            measured.extend(importlib.import_module(f"benchmarks.{name}").rows())
        except Exception as error:  # one that cannot run must not cost the others their figures
            failed.append(name)
            people.print(f"[bold red]{name} failed[/]: {type(error).__name__}: {error}")
    out = Console(width=None if sys.stdout.isatty() else 160)
    out.print(whole_table(measured))
    out.print(must_table(measured))
    if not chosen:
        load = os.getloadavg()
        machine = {
            "python": platform.python_version(),
            "machine": platform.machine(),
            "system": platform.release(),
            "cpus": os.cpu_count(),
            "load": load,
        }
        RESULTS.write_text(json.dumps({"machine": machine, "rows": [plain(row) for row in measured]}, indent=2) + "\n")
    return 1 if failed else 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
