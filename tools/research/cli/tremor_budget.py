"""Implements ``micron tremor budget``: it computes the cost of each source of error at the tip."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from firmware_py.endoscope.wiring import is_endoscope
from hal.bench import load_bench
from tools.cli.bench_option import BenchOption, bench_path
from tools.cli.common import JsonOption, clear_errors, console, print_whole
from tools.errors import InputError
from tools.output import check_writable, write_json
from tools.terminal import spinner, table_of


def budget(
    bench: BenchOption = None,
    seconds: Annotated[float, typer.Option(min=8.0, max=600.0, help="Virtual seconds of each run.")] = 15.0,
    ideal: Annotated[
        bool,
        typer.Option(
            "--ideal", help="Run with ideal sensors and manipulator and compare with the bound, instead of the budget."
        ),
    ] = False,
    json_file: JsonOption = None,
) -> None:
    """Simulate the closed loop with one source of error taken away at a time; with --ideal, with all of them
    away, beside the bound of the very hand.

    Example: micron tremor budget --seconds 20

    Example: micron tremor budget --ideal --seconds 15
    """
    from tools.reports.figures import FOUR_BANDS_HZ, band_name
    from tools.research.tremor.budget import budget as runs

    with clear_errors():
        check_writable(json_file)
        if is_endoscope(load_bench(bench_path(bench)).description):
            raise InputError("a budget of tremor belongs to the instrument; an endoscope bench cancels none")
        if ideal:
            _ideal(bench_path(bench), seconds, json_file)
            return
        with spinner(console()) as show:
            rows = list(runs(bench_path(bench), seconds, show))
        if json_file != "-":
            title = "tip tremor in 8-12 Hz, and the cost of each source in four bands, um rms (vectors)"
            costs = (f"cost {band_name(band)}" for band in FOUR_BANDS_HZ)
            table = table_of(title, "taken away", "without the loop", "with it", "less (%)", *costs)
            for row in rows:
                figures = (row.uncompensated_rms_um, row.compensated_rms_um, row.reduction_percent)
                name = "nothing: all errors on" if row is rows[0] else row.source
                table.add_row(name, *(f"{v:.2f}" for v in (*figures, *(band.cost_um for band in row.bands))))
            print_whole(table)
        write_json({"format": 1, "seconds": seconds, "rows": [row.as_dict() for row in rows]}, json_file)


def _ideal(bench: Path, seconds: float, json_file: str | None) -> None:
    from tools.research.tremor.ideal import GOAL, IdealRow, ideal_run

    rows: list[IdealRow] = []
    with spinner(console()) as show:
        for noise in (True, False):
            show(f"ideal instrument, accelerometer noise {'on' if noise else 'off'}")
            rows.append(ideal_run(bench, seconds, noise))
    if json_file != "-":
        title = "ideal instrument: left of 2-20 Hz, um rms, 8-12 Hz lifted"
        ratio = f"loop / bound, goal {GOAL:g}"
        table = table_of(title, "sensors", "loop", "estimator alone", "bound", ratio, "less in 8-12 Hz (%)")
        for row in rows:
            figures = (row.loop_um, row.estimator_um, row.bound_um, row.ratio, row.reduction_percent)
            table.add_row(row.what, *(f"{v:.2f}" for v in figures))
        print_whole(table)
    write_json({"format": 1, "seconds": seconds, "ideal": [row.as_dict() for row in rows]}, json_file)
