"""Implements ``micron soak``: it runs the closed loop for hours in virtual time."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer
from rich.progress import BarColumn, TextColumn, TimeRemainingColumn

from hal.bench import load_bench
from tools.cli.bench_option import BenchOption, bench_path
from tools.cli.common import JsonOption, clear_errors, console, data_console
from tools.errors import InputError
from tools.interrupt import note_stop
from tools.output import check_writable, write_json
from tools.research.results.artefact import write_result
from tools.research.stamp import revision_and_day
from tools.terminal import progress_bar


def soak(
    bench: BenchOption = None,
    seconds: Annotated[float, typer.Option(min=60.0, max=86_400.0, help="Virtual time of the run.")] = 1800.0,
    wires: Annotated[
        bool,
        typer.Option(
            "--wires/--without-wires", help="With or without buses and supervision; without them 15 times faster."
        ),
    ] = True,
    start_ns: Annotated[
        int, typer.Option(min=0, max=2**62, help="Start of the bench clock, in s, so that marks of time are crossed.")
    ] = 0,
    out: Annotated[
        Path | None, typer.Option(metavar="FILE", help="Put the block into this result (FILE.json or .md).")
    ] = None,
    json_file: JsonOption = None,
) -> None:
    """Run the closed loop for hours in virtual time and report memory, tremor and every counter by eighths.

    Exit status 1 when memory grew, the figures drifted, or something is not accounted for.

    Example: micron soak --seconds 28800 --without-wires --out docs/results/long-runs.json
    """
    from tools.research.faults.long_page import block, with_block
    from tools.research.faults.long_run import with_wires, without_wires

    with clear_errors():
        check_writable(json_file, out)
        name = "wires" if wires else "bare"
        if start_ns and not wires:
            raise InputError("--start-ns moves the clock of the buses; without wires there is none")
        if out is not None:
            with_block(out, name, "")  # a wrong file is refused before the work
        path = bench_path(bench)
        load_bench(path)
        with progress_bar(console(), TextColumn("virtual time"), BarColumn(), TimeRemainingColumn()) as progress:
            bar = progress.add_task("soak", total=seconds)
            on_time = lambda done_s: progress.update(bar, completed=done_s)  # noqa: E731
            if wires:
                run = with_wires(path, seconds, start_ns=start_ns, on_time=on_time)
            else:
                run = without_wires(path, seconds, on_time=on_time)
        if "SIGINT" in run.ended:
            note_stop()  # the firmware took the signal and ended in order
        asked = f"--seconds {seconds:g} " + (f"--start-ns {start_ns} " if start_ns else "")
        command = f"micron soak {asked}{'' if wires else '--without-wires '}--out {out or 'FILE'}"
        text = block(run, command, revision_and_day())
        if out is not None:
            write_result(out, with_block(out, name, text))
        if json_file != "-":
            data_console().print(text, markup=False, soft_wrap=True)
        write_json(run.as_dict(), json_file)
    if run.problems():
        raise typer.Exit(1)
