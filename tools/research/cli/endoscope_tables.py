"""``micron endoscope-tables``: the targeting experiment over mappings and response times."""

from __future__ import annotations

from typing import Annotated

import typer
from rich.progress import track
from rich.table import Table

from tools.cli.common import Exit, JsonOption, clear_errors, console, data_console
from tools.cli.endoscope import GainOption, SeedOption, mapping_of
from tools.output import check_writable, write_json


def endoscope_tables(
    gain: GainOption = 8.0,
    experiments: Annotated[int, typer.Option(min=1, max=100, help="Per cell.")] = 5,
    seed: SeedOption = 1,
    json_file: JsonOption = None,
) -> None:
    """Measure the elapsed time for both mappings and four response times with a synthetic user (Erat 2018, Tables 6.1
    and 6.2).

    Example: micron endoscope-tables --json out/mapping.json
    """
    from tools.endoscope.user import UserConfig
    from tools.research.reproduce.endoscope_experiment import RESPONSES_S, run_cell

    with clear_errors():
        check_writable(json_file)
        person = UserConfig(seed=seed)
        jobs = [(mapping, tau) for mapping in ("position", "speed") for tau in RESPONSES_S]
        cells = [
            run_cell(mapping_of(mapping), tau, person, gain=gain, experiments=experiments)
            for mapping, tau in track(jobs, "playing", console=console(), transient=True)
        ]
        grid = Table(title=f"synthetic user, K = {gain:g}, {experiments} experiments a cell", title_justify="left")
        for column in ("mapping", "tau (s)", "time (s)", "mean (s)", "clicks", "psi, theta (deg)"):
            grid.add_column(column, justify="right")
        for cell in cells:
            times = " ".join(f"{v:.0f}" for v in cell.elapsed_s)
            psi, theta = cell.rotation_deg
            clicks = f"{sum(cell.clicks) / len(cell.clicks):.1f}"
            grid.add_row(
                cell.mapping, f"{cell.response_s:g}", times, f"{cell.mean_s:.1f}", clicks, f"{psi:.1f}, {theta:.1f}"
            )
        data_console().print(grid)
        rows = [
            {
                "mapping": cell.mapping,
                "response_s": cell.response_s,
                "elapsed_s": list(cell.elapsed_s),
                "mean_s": cell.mean_s,
                "clicks": list(cell.clicks),
                "rotation_deg": list(cell.rotation_deg),
                "done": cell.done,
            }
            for cell in cells
        ]
        write_json({"format": 1, "gain": gain, "rows": rows}, json_file)
        if not all(cell.done for cell in cells):
            raise typer.Exit(Exit.FAILED)
