"""Implements ``micron manipulator``: it computes the workspace of the tip."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from tools.cli.bench_option import BenchOption, bench_path
from tools.cli.common import JsonOption, clear_errors, console, data_console, place_picture
from tools.output import check_writable, write_json
from tools.terminal import table_of

PICTURE = Path("out/workspace.png")
"""Default file of the picture."""


def manipulator(
    bench: BenchOption = None,
    out: Annotated[
        Path | None, typer.Option(metavar="PNG", help=f"Picture of the workspace; default {PICTURE}.")
    ] = None,
    json_file: JsonOption = None,
) -> None:
    """Compute extents, largest sphere, singularity and conditioning of the bench's manipulator.

    The table shows the tremor of 50 um beside them.

    Example: micron manipulator --out out/workspace.png
    """
    from dataclasses import asdict

    from firmware_py.control.plan import load_plan
    from hal.bench import load_bench
    from tools.research.manipulator.picture import save_workspace_picture
    from tools.research.manipulator.workspace import analyse

    with clear_errors():
        check_writable(json_file, out)
        picture = place_picture(out, PICTURE)
        config = load_plan(load_bench(bench_path(bench))).stages.actuation
        analysis = analyse(config)
        table = table_of("Workspace of the tip (Ang 2004, Table 6.1, sec. 6.1.1)", "quantity", "required", "ours")
        x, y, z = analysis.extent_m * 1e6
        table.add_row("extent x (um)", "> 1000", f"{x:.0f}")
        table.add_row("extent y (um)", "> 1000", f"{y:.0f}")
        table.add_row("extent z (um)", "> 100", f"{z:.1f}")
        table.add_row("largest sphere, diameter (um)", ">= 100", f"{1e6 * analysis.sphere_m:.1f}")
        table.add_row("the same around neutral (um)", "> 50 (tremor)", f"{1e6 * analysis.neutral_sphere_m:.1f}")
        table.add_row(
            "tilt in use, at the singularity (deg)", "", f"{analysis.tilt_deg:.2f}, {analysis.singular_deg:.1f}"
        )
        table.add_row("condition of the Jacobian, largest", "", f"{analysis.condition:.1f}")
        table.add_row("determinant, smallest / at neutral", "> 0", f"{analysis.determinant:.3f}")
        table.add_row("forward(inverse(tip)) - tip (nm)", "< 1", f"{1e9 * analysis.identity_m:.1e}")
        table.add_row("Newton steps from level, most", "<= 3", str(analysis.newton))
        data_console().print(table)
        if picture is not None:
            save_workspace_picture(config, analysis, picture)
            console().print(f"picture: {picture}")
        written = None if picture is None else str(picture)
        write_json({"format": 1, "picture": written, **asdict(analysis)}, json_file)
