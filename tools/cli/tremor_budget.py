"""``micron tremor budget``: what each source of error costs at the tip."""

from __future__ import annotations

from typing import Annotated

import typer
from rich.progress import Progress, SpinnerColumn, TextColumn, TimeElapsedColumn
from rich.table import Table

from hal.bench import load_bench
from tools.cli.bench_option import BenchOption, bench_path
from tools.cli.common import JsonOption, check_writable, clear_errors, console, data_console, write_json


def budget(
    bench: BenchOption = None,
    seconds: Annotated[float, typer.Option(min=8.0, max=600.0, help="Virtual seconds of each run.")] = 15.0,
    json_file: JsonOption = None,
) -> None:
    """The closed loop in virtual time with one source of error taken away at a time.

    Example: micron tremor budget --seconds 20
    """
    from tools.tremor.budget import budget as runs

    with clear_errors():
        check_writable(json_file)
        load_bench(bench_path(bench))
        with Progress(
            SpinnerColumn(), TextColumn("{task.description}"), TimeElapsedColumn(), console=console(), transient=True
        ) as progress:
            task = progress.add_task("starting")
            rows = list(runs(bench_path(bench), seconds, lambda text: progress.update(task, description=text)))
        if json_file != "-":
            shown = Table(title="tip tremor in 8-12 Hz, um rms (vector)", title_justify="left")
            shown.add_column("taken away")
            for name in ("without the loop", "with it", "less (%)", "cost"):
                shown.add_column(name, justify="right")
            for row in rows:
                figures = (row.uncompensated_rms_um, row.compensated_rms_um, row.reduction_percent, row.cost_um)
                name = "nothing: all errors on" if row is rows[0] else row.source
                shown.add_row(name, *(f"{v:.2f}" for v in figures))
            data_console().print(shown)
        write_json({"format": 1, "seconds": seconds, "rows": [row.as_dict() for row in rows]}, json_file)
