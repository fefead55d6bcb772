"""``make bench [ONLY="step world"]``: every benchmark, one table, ``results.json`` (contracts/commands.md).

Each module runs in a process of its own: one that fails or hangs is shown as failed and the rest go on.
"""

from __future__ import annotations

import importlib
import json
import math
import os
import signal
import subprocess
import sys
import tempfile
import time
from dataclasses import asdict, dataclass
from pathlib import Path

from rich.console import Console
from rich.table import Table

from benchmarks.machine import machine
from benchmarks.row import Row
from hal.children import use_one_thread
from hal.jsonable import to_jsonable

RESULTS = Path(__file__).with_name("results.json")
PAGE = Path(__file__).with_name("results.md")
MODULES = (
    "step", "kinematics", "latency", "wire", "loop", "world", "attitude", "noise", "hysteresis", "mismatch", "recorder",
    "memory", "start", "bench_page",
)  # fmt: skip
LIMIT_S = 600.0
"""A module that takes longer is stopped; the mismatch engine with 30 min of recording takes about half of it."""


@dataclass(frozen=True)
class Failure:
    """A module without figures."""

    module: str
    reason: str


def number(value: float) -> str:
    return "-" if not math.isfinite(value) else f"{value:.3g}"


def whole_lines(rows: list[Row]) -> list[tuple[str, ...]]:
    """Everything that was measured, titles first."""
    lines = [("benchmark", "ours", "peer", "unit", "ratio", "what")]
    for row in rows:
        peer = f"{number(row.peer)} ({row.peer_name})"
        lines.append((row.name, number(row.ours), peer, row.unit, number(row.ratio), row.what))
    return lines


def must_lines(rows: list[Row]) -> list[tuple[str, ...]]:
    """What it must reach: met, not met and why."""
    lines = [("figure", "goal", "found", "met", "why not")]
    for row in rows:
        if row.must:
            met = "not measured" if row.meets is None else "met" if row.meets else "NOT met"
            found = f"{number(row.ours)} {row.unit}, ratio {number(row.ratio)} to {row.peer_name}"
            lines.append((row.name, row.goal, found, met, row.why if not row.meets else ""))
    return lines


def table(title: str, lines: list[tuple[str, ...]]) -> Table:
    """For a terminal."""
    drawn = Table(title=title, title_justify="left")
    for column in lines[0]:
        drawn.add_column(column, justify="right" if column in ("ours", "ratio") else "left", overflow="fold")
    for line in lines[1:]:
        drawn.add_row(*line)
    return drawn


def page(rows: list[Row], failed: list[Failure], about: dict[str, object]) -> str:
    """``results.md``."""

    def markdown(lines: list[tuple[str, ...]]) -> str:
        cells = ["| " + " | ".join(cell.replace("|", "/") for cell in line) + " |" for line in lines]
        return "\n".join([cells[0], "|" + "---|" * len(lines[0]), *cells[1:]])

    facts = "\n".join(f"- {name}: {value}" for name, value in about.items())
    parts = [
        "# Results of make bench",
        "Ratios within this run; absolute figures are of this machine. Written by `python -m benchmarks`.",
        facts,
        "## What it must reach",
        markdown(must_lines(rows)),
        "## Everything",
        markdown(whole_lines(rows)),
    ]
    if failed:
        parts += ["## Failed", "\n".join(f"- {f.module}: {f.reason}" for f in failed)]
    return "\n\n".join(parts) + "\n"


def row_of(found: dict[str, object]) -> Row:
    """``plain`` backwards."""
    return Row(**{k: math.nan if v is None and k in ("ours", "peer", "ratio") else v for k, v in found.items()})  # type: ignore[arg-type]


def work(module: str, destination: Path) -> None:
    """In the module's own process: its rows as JSON lines, each written when it is known."""
    with destination.open("w") as file:
        for row in importlib.import_module(f"benchmarks.{module}").rows():
            file.write(json.dumps(to_jsonable(asdict(row))) + "\n")
            file.flush()


def measure(module: str, folder: Path) -> tuple[list[Row], Failure | None]:
    """Rows of ``module``, also those that it had before it failed."""
    destination = folder / f"{module}.jsonl"
    command = [sys.executable, "-m", "benchmarks", "--rows", module, str(destination)]
    failure = None
    # a session of its own, so that a module's servers and firmware end with it
    with subprocess.Popen(command, stderr=subprocess.PIPE, text=True, start_new_session=True) as process:
        try:
            said = process.communicate(timeout=LIMIT_S)[1]
            if process.returncode:
                last = (said.strip().splitlines() or [f"exit status {process.returncode}"])[-1]
                failure = Failure(module, last)
        except subprocess.TimeoutExpired:
            failure = Failure(module, f"not done after {LIMIT_S:g} s")
            os.killpg(process.pid, signal.SIGKILL)
        except KeyboardInterrupt:
            os.killpg(process.pid, signal.SIGKILL)
            raise
    lines = destination.read_text().splitlines() if destination.exists() else []
    return [row_of(json.loads(line)) for line in lines], failure


def main(chosen: list[str]) -> int:
    """Measure ``chosen``, or everything. ``--page FILE`` behind the names writes the tables to FILE, too."""
    own_page = None
    if chosen[-2:-1] == ["--page"]:
        chosen, own_page = chosen[:-2], Path(chosen[-1])
    people = Console(stderr=True)
    unknown = sorted(set(chosen) - set(MODULES))
    if unknown:
        people.print(f"no benchmark {', '.join(unknown)}; there are {', '.join(MODULES)}")
        return 2
    measured: list[Row] = []
    failed: list[Failure] = []
    about = machine()
    began_s = time.monotonic()
    modules = [name for name in MODULES if not chosen or name in chosen]
    with tempfile.TemporaryDirectory(prefix="micron-") as folder:
        for i, name in enumerate(modules, 1):
            people.print(f"measuring {name}, {i} of {len(modules)} ({time.monotonic() - began_s:.0f} s so far)")
            rows, failure = measure(name, Path(folder))
            measured += rows
            if failure is not None:
                failed.append(failure)
                people.print(f"[bold red]{name} failed[/]: {failure.reason}", highlight=False)
    about["took_s"] = round(time.monotonic() - began_s)
    out = Console(width=None if sys.stdout.isatty() else 160)
    out.print(table("Ratios within this run; absolute figures are of this machine", whole_lines(measured)))
    out.print(table("What it must reach", must_lines(measured)))
    for failure in failed:
        out.print(f"failed: {failure.module}: {failure.reason}", highlight=False)
    if not chosen:
        tables = {
            "machine": about,
            "rows": [to_jsonable(asdict(row)) for row in measured],
            "failed": [asdict(f) for f in failed],
        }
        RESULTS.write_text(json.dumps(tables, indent=2) + "\n")
        PAGE.write_text(page(measured, failed, about))
    if own_page is not None:
        own_page.write_text(page(measured, failed, about))
    return 1 if failed else 0


if __name__ == "__main__":
    use_one_thread()
    if sys.argv[1:2] == ["--rows"]:
        work(sys.argv[2], Path(sys.argv[3]))
    else:
        sys.exit(main(sys.argv[1:]))
