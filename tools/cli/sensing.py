"""``micron sensing``: what the sensing stage achieves on emulated sensors, source by source."""

from __future__ import annotations

from typing import Annotated

import typer
from rich.table import Table

from tools.cli.common import JsonOption, check_writable, clear_errors, console, data_console, write_json

app = typer.Typer(no_args_is_help=True, help="Error budgets of the sensing stage on emulated sensors.")


@app.command("budget")
def budget(
    seconds: Annotated[float, typer.Option(min=20.0, max=600.0, help="Length of each run.")] = 40.0,
    json_file: JsonOption = None,
) -> None:
    """Error of the tip displacement in 8 to 12 Hz after calibration, and the share of each error source.

    Example: micron sensing budget --json out/budget.json
    """
    from dataclasses import asdict

    from tools.reproduce.sensing_budget import budget as compute

    with clear_errors():
        check_writable(json_file)
        with console().status("calibrating and running every variant"):
            found = compute(seconds)
        table = Table(title="Tip displacement, 8 to 12 Hz, rms error (um, vector)", title_justify="left")
        for heading in ("source", "alone", "all but this", "share of the square"):
            table.add_column(heading, justify="left" if heading == "source" else "right")
        for share in sorted(found.shares, key=lambda s: -s.share):
            table.add_row(
                share.source, f"{share.alone_um:.2f}", f"{share.without_um:.2f}", f"{100.0 * share.share:.1f} %"
            )
        table.add_row("none (filters, quantisation)", f"{found.floor_um:.2f}", "", "")
        table.add_row("all", f"{found.total_um:.2f}", "", "")
        data_console().print(table)
        data_console().print(
            "all sources by body axis: "
            + ", ".join(f"{e:.2f} of {t:.1f}" for e, t in zip(found.axes_um, found.tremor_um, strict=True))
            + " um rms (goal: 5)"
        )
        write_json({"format": 1, "seconds": seconds, **asdict(found)}, json_file)
