"""Implements ``micron noise``: it fits the stochastic model of sensors at rest."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer
from rich.table import Table

from tools.cli.bench_option import bench_path
from tools.cli.common import JsonOption, clear_errors, console, data_console, place_picture
from tools.errors import InputError
from tools.interrupt import keep_what_is_there, need_some
from tools.output import check_names, check_writable, write_json

if TYPE_CHECKING:
    from tools.calibrate.logs import SensorLog

PICTURE = Path("out/noise.png")
"""Default file of the picture."""


def noise(
    *,
    recording: Annotated[
        Path,
        typer.Argument(metavar="RECORDING", help="Recording of a sensor at rest: folder, .toml, or a data file."),
    ],
    column: Annotated[list[str] | None, typer.Option(help="Column to analyse; default all.")] = None,
    rate_hz: Annotated[float | None, typer.Option(min=1e-6, help="Sampling rate, if the file does not say.")] = None,
    scale: Annotated[float, typer.Option(help="Factor from counts to a unit.")] = 1.0,
    shortest_s: Annotated[
        float | None,
        typer.Option(min=0.0, help="Shortest averaging time of the fit; default: where the noise terms explain it."),
    ] = None,
    bench: Annotated[
        Path | None,
        typer.Option(
            metavar="FILE|NAME", help="Bench of the instrument that made the log; its calibrated axes are used."
        ),
    ] = None,
    image: Annotated[
        Path | None,
        typer.Option("--picture", metavar="FILE", help=f"Picture (PNG) of the deviation; default {PICTURE}."),
    ] = None,
    json_file: JsonOption = None,
) -> None:
    """Compute the overlapping Allan deviation of a recording and fit white noise, flicker, random walk and ramp.

    The JSON is what a bench names as [firmware] noise = "FILE": the attitude filters then use these figures.

    Example: micron noise rest.npz --rate-hz 100 --picture noise.png

    For a bench: micron noise out/rest --bench micron --shortest-s 0.1 --json out/noise.json
    """
    from dataclasses import asdict

    from tools.calibrate.instrument_log import calibrated_log
    from tools.calibrate.logs import load_log
    from tools.noise.allan import TERMS, AllanCurve, NoiseModel, allan_curve, identify
    from tools.noise.picture import save_allan_picture

    with clear_errors():
        check_names(image)
        if scale == 0.0:
            raise InputError("--scale 0: nothing would be left of the signal; give the unit's size of one count")
        check_writable(json_file, image, reads=[recording, bench])
        image = place_picture(image, PICTURE, reads=[recording, bench])
        log = load_log(recording, rate_hz)
        if bench is not None:
            log = calibrated_log(log, bench_path(bench))
        names = column or _columns(log)
        if log.gaps:
            console().print(f"{log.path}: time jumps ahead {log.gaps} times; the deviation takes the samples as even")
        rate = log.need_rate()
        models: dict[str, tuple[AllanCurve, NoiseModel]] = {}
        with keep_what_is_there():
            for name in names:
                try:
                    curve = allan_curve(log.matrix((name,))[:, 0] * scale, rate)
                    models[name] = curve, identify(curve, shortest_s)
                except ValueError as error:
                    if isinstance(error, InputError):
                        raise
                    raise InputError(f"{log.path}: '{name}': {error}") from error
        need_some(models)
        table = Table(title=f"{log.path}, {rate:g} Hz", title_justify="left")
        for heading in ("column", "N (unit sqrt s)", "B (unit)", "K (unit/sqrt s)", "R (unit/s)", "fit from (s)"):
            table.add_column(heading, no_wrap=heading == "column")
        for name, (_, model) in models.items():
            cells = []
            for term in TERMS:
                c = getattr(model, term)
                seen = f"{c.value:.3g} [{c.low:.2g}, {c.high:.2g}]"
                cells.append(seen if c.value > 0.0 else f"< {c.high:.2g}")
            missed = f", off by {100.0 * model.excess:.0f} %" if model.excess > 0.0 else ""
            table.add_row(name, *cells, f"{model.shortest_s:g}{missed}")
        data_console().print(table)
        if image is not None:
            save_allan_picture(models, image)
            console().print(f"picture: {image}")
        write_json(
            {
                "format": 1,
                "rate_hz": rate,
                "scale": scale,
                "shortest_s": min(model.shortest_s for _, model in models.values()),
                "columns": {n: {"curve": asdict(c), "model": asdict(m)} for n, (c, m) in models.items()},
            },
            json_file,
        )


def _columns(log: SensorLog) -> list[str]:
    """Return the columns that are analysed by default."""
    import numpy as np

    names = [name for name in log.columns if name not in (log.time_column, "t_ns")]
    if {"tick", "volts_0"} <= set(names):
        console().print(f"{log.path}: of micron run: the converter's inputs; others by --column or --bench")
        names = [name for name in names if name.startswith("volts_")]
    still = [name for name in names if np.ptp(log.matrix((name,))) == 0.0]
    if still:
        console().print(f"{log.path}: left out, they never change: {', '.join(still)}")
    if len(still) == len(names):
        raise InputError(f"{log.path}: no column changes: a frozen sensor has no noise to identify")
    return [name for name in names if name not in still]
