"""``make bench [ONLY="step world"] [ROUNDS=5]``: every benchmark, one table, ``results.json`` (contracts/commands.md).

Each module runs in a process of its own: one that fails or hangs is shown as failed and the rest go on. With several
rounds a row has the medians and says within what its ratio lay.
"""

from __future__ import annotations

import argparse
import importlib
import json
import math
import os
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from statistics import median

from rich.console import Console
from rich.table import Table

from benchmarks.machine import machine
from benchmarks.row import Row
from hal.children import use_one_thread
from hal.jsonable import to_jsonable

RESULTS = Path(__file__).with_name("results.json")
PAGE = Path(__file__).with_name("results.md")
MODULES = (
    "step", "kinematics", "latency", "wire", "loop", "world", "attitude", "noise", "hysteresis", "mismatch",
    "equations", "recorder", "memory", "start", "bench_page",
)  # fmt: skip
LIMIT_S = 1200.0
"""A module that takes longer is stopped. The longest is the wire, about half of it on a slow machine."""


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


def median_rows(rounds: Sequence[Sequence[Row]]) -> list[Row]:
    """Return one row for each name: its medians over ``rounds``, and its goal as most of them have it. ``what`` says in
    how many rounds the goal was met and within what the ratio lay."""
    names = list(dict.fromkeys(row.name for one in rounds for row in one))
    return [_median_row([row for one in rounds for row in one if row.name == name]) for name in names]


def _median_row(found: list[Row]) -> Row:
    if len(found) == 1:
        return found[0]
    ratios = sorted(row.ratio for row in found)
    what = f"{len(found)} rounds, ratio {number(ratios[0])} to {number(ratios[-1])}"
    judged = [row.meets for row in found if row.meets is not None]
    if judged:
        what += f", goal met in {sum(judged)}"
    ours, peer = median(row.ours for row in found), median(row.peer for row in found)
    meets = 2 * sum(judged) > len(judged) if judged else None
    why = found[-1].why if meets is False else ""
    return replace(found[-1], what=what, ours=ours, peer=peer, ratio=median(ratios), meets=meets, why=why)


@dataclass(frozen=True)
class Request:
    """Holds what the command line asks for: modules, rounds of each, and a file for the tables."""

    chosen: list[str]
    rounds: int = 1
    page: Path | None = None


def parse(words: Sequence[str]) -> Request:
    """Return what ``words`` ask for: names of modules, ``--rounds N`` and ``--page FILE``."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks", description="Measure, and compare in one run.")
    parser.add_argument("modules", nargs="*", metavar="MODULE", help=", ".join(MODULES))
    parser.add_argument("--rounds", type=int, default=1, metavar="N", help="measure N times and show the medians")
    parser.add_argument("--page", type=Path, metavar="FILE", help="write the tables to FILE, too")
    asked = parser.parse_args(words)
    if unknown := sorted(set(asked.modules) - set(MODULES)):
        parser.error(f"no benchmark {', '.join(unknown)}; there are {', '.join(MODULES)}")
    if asked.rounds < 1:
        parser.error(f"--rounds {asked.rounds}: at least 1 round is needed")
    return Request(asked.modules, asked.rounds, asked.page)


def main(asked: Request) -> int:
    """Measure the modules that are ``asked`` for, or all."""
    chosen, own_page = asked.chosen, asked.page
    people = Console(stderr=True)
    measured: list[Row] = []
    failed: list[Failure] = []
    about = machine()
    began_s = time.monotonic()
    modules = [name for name in MODULES if not chosen or name in chosen]
    with tempfile.TemporaryDirectory(prefix="micron-") as folder:
        for i, name in enumerate(modules, 1):
            people.print(f"measuring {name}, {i} of {len(modules)} ({time.monotonic() - began_s:.0f} s so far)")
            rounds: list[list[Row]] = []
            for _ in range(asked.rounds):
                rows, failure = measure(name, Path(folder))
                rounds.append(rows)
                if failure is not None:
                    failed.append(failure)
                    people.print(f"[bold red]{name} failed[/]: {failure.reason}", highlight=False)
            measured += median_rows(rounds)
    if asked.rounds > 1:
        about["rounds"] = asked.rounds
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
        sys.exit(main(parse(sys.argv[1:])))
