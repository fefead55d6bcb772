"""``micron hands``: the closed loop on recorded tremor, as a table."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer
from rich.progress import Progress, SpinnerColumn, TimeElapsedColumn

from hal.bench import load_bench
from tools.cli.bench_option import BenchOption, bench_path
from tools.cli.common import JsonOption, clear_errors, console
from tools.errors import InputError
from tools.interrupt import keep_what_is_there, need_some
from tools.output import check_writable, write_json, write_text_atomic
from tools.stamp import revision_and_day
from tools.terminal import task_name


def hands(
    bench: BenchOption = None,
    data: Annotated[Path, typer.Option(metavar="FOLDER", help="Folder of the real recordings.")] = Path(
        "../shared/data"
    ),
    seconds: Annotated[float, typer.Option(min=8.0, max=600.0)] = 40.0,
    out: Annotated[Path | None, typer.Option(metavar="FILE", help="Write the page (Markdown).")] = None,
    json_file: JsonOption = None,
) -> None:
    """Run the instrument in every recorded hand, with each estimator, in virtual time, beside the limits.

    Example: micron hands --out docs/first-results.md
    """
    from tools.reports.hands import HandRow, markdown, run_hands

    with clear_errors():
        check_writable(json_file, out)
        if not data.is_dir():
            raise InputError(f"{data}: no such folder; name the recordings with --data FOLDER")
        file = load_bench(bench_path(bench))
        rows: list[HandRow] = []
        with Progress(SpinnerColumn(), task_name(), TimeElapsedColumn(), console=console(), transient=True) as progress:
            task = progress.add_task("starting")
            with keep_what_is_there():
                for row in run_hands(file, data, seconds, lambda text: progress.update(task, description=text)):
                    rows.append(row)  # noqa: PERF402 - what is there when Ctrl-C comes is kept
        need_some(rows)
        page = markdown(rows, seconds, revision_and_day())
        if out is not None:
            write_text_atomic(out, page)
        if json_file != "-":
            typer.echo(page)
        write_json({"format": 1, "seconds": seconds, "rows": [row.as_dict() for row in rows]}, json_file)
