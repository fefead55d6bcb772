"""Implements ``micron sensing``: it computes the errors of the sensing stage on emulated sensors, source by source."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer
from rich.table import Table

from hal.types import STANDARD_GRAVITY
from tools.cli.common import JsonOption, clear_errors, console, data_console
from tools.errors import InputError
from tools.output import check_names, check_writable, write_json
from tools.terminal import table_of

app = typer.Typer(help="Compute error budgets of the sensing stage on emulated sensors.")


@app.command("budget")
def budget(
    seconds: Annotated[float, typer.Option(min=20.0, max=600.0, help="Length of each run.")] = 40.0,
    json_file: JsonOption = None,
) -> None:
    """Compute the error of the tip displacement in 8 to 12 Hz after calibration, and the share of each error source.

    Example: micron sensing budget --json out/budget.json
    """
    from dataclasses import asdict

    from tools.research.reproduce.sensing_budget import budget as compute

    with clear_errors():
        check_writable(json_file)
        with console().status("calibrating and running every variant"):
            budget = compute(seconds)
        title = "Tip displacement, 8 to 12 Hz, rms error (um, vector)"
        table = table_of(title, "source", "alone", "all but this", "share of the square")
        for share in sorted(budget.shares, key=lambda s: -s.share):
            table.add_row(
                share.source, f"{share.alone_um:.2f}", f"{share.without_um:.2f}", f"{100.0 * share.share:.1f} %"
            )
        table.add_row("none (filters, quantisation)", f"{budget.floor_um:.2f}", "", "")
        table.add_row("all", f"{budget.total_um:.2f}", "", "")
        data_console().print(table)
        data_console().print(
            "all sources by body axis: "
            + ", ".join(f"{e:.2f} of {t:.1f}" for e, t in zip(budget.axes_um, budget.tremor_um, strict=True))
            + " um rms (goal: 5)"
        )
        write_json({"format": 1, "seconds": seconds, **asdict(budget)}, json_file)


@app.command("variance")
def variance(
    configurations: Annotated[
        list[str],
        typer.Argument(
            metavar="CONFIGURATION...",
            help="micron-000, micron-004, micron-004-turned, cube-004, proposed-004, a bench, a TOML file with "
            "format = 1, positions_mm and axes, or the JSON of `micron placement`.",
        ),
    ],
    noise_mg: Annotated[float, typer.Option(min=1e-6, help="Noise of an axis behind its 15 Hz filter, rms.")] = 0.535,
    gyroscope_deg_s: Annotated[
        float, typer.Option(min=1e-9, help="Noise of a gyroscope behind the same filter, rms (ADXRS150: 0.75).")
    ] = 0.75,
    tip_mm: Annotated[str, typer.Option(help="Position of the tip in the body frame.")] = "0,0,155",
    turning_deg_s: Annotated[str, typer.Option(help="Body rate at which the solver is examined.")] = "0,0,0",
    image: Annotated[Path, typer.Option("--picture", metavar="FILE", help="Picture (PNG) of the comparison.")] = Path(
        "out/variance.png"
    ),
    json_file: JsonOption = None,
) -> None:
    """Compute the error variance of accelerometer configurations, linear and unscented, beside a conventional 3G-3A.

    Example: micron sensing variance micron-000 proposed-004 --noise-mg 2.25 --json out/variance.json
    """
    from dataclasses import asdict

    import numpy as np

    from tools.research.placement.analysis import (
        BAND_HZ,
        DOWN_40,
        Analysis,
        Conditions,
        all_accelerometers,
        conventional,
    )
    from tools.research.placement.analysis_picture import save_analysis_picture
    from tools.research.placement.configuration_file import load_configuration
    from tools.research.placement.propositions import verdicts

    def cells(values: object, factor: float) -> str:
        return "-" if values is None else ", ".join(f"{factor * v:.3g}" for v in np.asarray(values)[:3])

    with clear_errors():
        check_names(image)
        check_writable(json_file)
        conditions = Conditions(
            _vector(tip_mm, "--tip-mm") * 1e-3,
            np.array(DOWN_40),
            float(np.radians(gyroscope_deg_s)),
            np.radians(_vector(turning_deg_s, "--turning-deg-s")),
        )
        analyses: list[Analysis] = []
        judged: list[str] = []
        for given in configurations:
            placement, noise = load_configuration(given, noise_mg)
            try:
                analyses.append(all_accelerometers(placement, noise, conditions))
                judged += verdicts(placement)
            except ValueError as error:
                raise error if isinstance(error, InputError) else InputError(f"{given}: {error}") from error
        analyses.append(conventional(np.zeros(3), noise_mg * 1e-3 * STANDARD_GRAVITY, conditions))
        band = f"{BAND_HZ[0]:g}-{BAND_HZ[1]:g} Hz"
        table = Table(title="Rms error by body axis x, y, z, from sensor noise alone", title_justify="left")
        for heading in ("quantity", *(a.name for a in analyses)):
            table.add_column(heading, overflow="fold")
        rows = (
            ("axes", [str(a.axes) for a in analyses]),
            ("angular acceleration (rad/s^2)", [cells(a.alpha, 1.0) for a in analyses]),
            ("rate, one increment, linear (deg/s)", [cells(a.rate_linear, 180.0 / np.pi) for a in analyses]),
            ("rate, one increment, unscented (deg/s)", [cells(a.rate_unscented, 180.0 / np.pi) for a in analyses]),
            (f"rate, {band} (deg/s)", [cells(a.rate_band, 180.0 / np.pi) for a in analyses]),
            ("acceleration at the sensors' centroid (mm/s^2)", [cells(a.force_centre, 1e3) for a in analyses]),
            ("acceleration of the tip (mm/s^2)", [cells(a.force_tip, 1e3) for a in analyses]),
            (f"tip displacement, {band} (um)", [cells(a.tip_band_m, 1e6) for a in analyses]),
        )
        for name, values in rows:
            table.add_row(name, *values)
        data_console().print(table)
        for line in judged:
            data_console().print(line, highlight=False)
        console().print(
            "an increment of the rate is not its error: that is a random walk (erratum 20), compare the bands"
        )
        save_analysis_picture(analyses, image)
        console().print(f"picture: {image}")
        write_json(
            {
                "format": 1,
                "band_hz": BAND_HZ,
                "noise_mg": noise_mg,
                "gyroscope_deg_s": gyroscope_deg_s,
                "configurations": [asdict(a) for a in analyses],
                "propositions": judged,
            },
            json_file,
        )


def _vector(text: str, option: str):
    import numpy as np

    try:
        values = np.array([float(part) for part in text.split(",")])
    except ValueError as error:
        raise InputError(f"{option} {text}: three numbers with commas are needed") from error
    if values.shape != (3,) or not np.all(np.isfinite(values)):
        raise InputError(f"{option} {text}: three numbers with commas are needed")
    return values
