"""``micron faults``: the fault campaign on the emulated bench."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Annotated

import typer
from rich.progress import BarColumn, Progress, TextColumn, TimeElapsedColumn
from rich.table import Table

from firmware_py.recording.revision import git_revision
from hal.bench import load_bench
from tools.cli.bench_option import BenchOption, bench_path
from tools.cli.common import JsonOption, clear_errors, console, data_console
from tools.errors import InputError
from tools.faults.campaign import run_campaign, totals
from tools.faults.catalogue import faults as catalogue
from tools.faults.page import markdown
from tools.faults.points import POINTS
from tools.output import check_writable, write_json, write_text_atomic


def faults(
    bench: BenchOption = None,
    seeds: Annotated[int, typer.Option(min=1, max=1000, help="Runs per fault and operating point.")] = 3,
    only: Annotated[str, typer.Option(metavar="TEXT", help="Only faults whose name contains this.")] = "",
    jobs: Annotated[int, typer.Option(min=1, help="Processes.")] = os.cpu_count() or 1,
    out: Annotated[Path | None, typer.Option(metavar="FILE", help="Write the page (Markdown).")] = None,
    json_file: JsonOption = None,
) -> None:
    """Break the emulated instrument in every way of the catalogue, and print what it did.

    Exit status 1 when an output was unsafe, a sample uncounted or a message wrong.

    Example: micron faults --seeds 20 --out docs/reliability.md
    """
    with clear_errors():
        check_writable(json_file, out)
        path = bench_path(bench)
        description = load_bench(path).description
        if len(description.emulated_buses()) < len(description.bus):
            raise InputError(f"{path}: faults are injected into emulated benches only; use a bench of sim:// buses")
        chosen = [fault for fault in catalogue() if only.lower() in fault.name.lower()]
        if not chosen:
            raise InputError(
                f"--only {only!r}: no fault is called so; names begin with serial, daq, sensor, output bus ..."
            )
        with Progress(
            TextColumn("{task.description}"), BarColumn(), TimeElapsedColumn(), console=console(), transient=True
        ) as progress:
            task = progress.add_task("starting", total=len(POINTS) * seeds)
            rows = run_campaign(
                path,
                chosen,
                seeds=range(1, seeds + 1),
                jobs=jobs,
                progress=lambda text: progress.update(task, advance=1, description=text),
            )
        total = totals(rows)
        if out is not None:
            command = f"micron faults --seeds {seeds} --out {out}"
            write_text_atomic(out, markdown(rows, command, git_revision() or "unknown"))
        if json_file != "-":
            _print(rows, total)
        write_json({"format": 1, "rows": [row.as_dict() for row in rows], "totals": total}, json_file)
    if total["unsafe_outputs"] or total["uncounted_samples"] or total["wrong_messages"]:
        raise typer.Exit(1)


def _print(rows: list, total: dict) -> None:
    table = Table("fault", "hand", "answer", "known ms", "neutral ms", "tip um", "as expected", title="Faults")
    for row in rows:
        d = row.as_dict()
        known, neutral = d["detect_ms"]["max"], d["answer_ms"]["max"]
        table.add_row(
            row.fault.name,
            row.point,
            row.answer,
            "-" if known is None else f"{known:.1f}",
            "NOT confirmed" if d["not_confirmed"] else "-" if neutral is None else f"{neutral:.1f}",
            f"{d['tip_error_um_max']:.1f}",
            f"{row.as_expected}/{row.seeds}",
        )
    data_console().print(table)
    for name, value in total.items():
        data_console().print(f"{name.replace('_', ' ')}: {value}")
