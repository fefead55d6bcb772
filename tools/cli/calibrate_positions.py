"""Implements ``micron calibrate positions``: it finds where the accelerometers sit, from a swing about the tip."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from tools.cli.bench_option import bench_path
from tools.cli.calibrate_axes import Rate
from tools.cli.common import JsonOption, clear_errors, console, data_console
from tools.output import check_writable, write_calibration, write_json
from tools.terminal import table_of


def positions(
    recording: Annotated[
        Path,
        typer.Argument(
            metavar="RECORDING", help="Recording of the instrument swung about its tip in a dimple for a minute."
        ),
    ],
    bench: Annotated[
        Path, typer.Option(metavar="FILE|NAME", help="Bench of the instrument; all but the positions is calibrated.")
    ],
    out: Annotated[Path | None, typer.Option("--out", metavar="FILE", help="Calibration file for the bench.")] = None,
    rate_hz: Rate = None,
    json_file: JsonOption = None,
) -> None:
    """Find the positions of the accelerometers with 95 % intervals; name the file under [firmware] calibration of the
    bench.

    Put the tip into a dimple, switch the manipulator to neutral, swing the handle by 20 degrees and more about all
    axes, slowly and at 1 to 2 Hz mixed, for a minute.

    A recording to try: python -m sim_devices.plant.lab pivot --bench benches/micron.toml --out out/pivot

    Example: micron calibrate positions out/pivot --bench micron --out out/positions.toml
    """
    from tools.calibrate.calibration_file import calibration_toml
    from tools.calibrate.instrument_log import bench_sensing, instrument_readings
    from tools.calibrate.logs import load_log
    from tools.calibrate.positions import fit_positions

    with clear_errors():
        check_writable(json_file, out)
        config = bench_sensing(bench_path(bench))
        log = load_log(recording, rate_hz)
        readings, field = instrument_readings(log, config)
        with console().status("fitting the swing"):
            fit = fit_positions(readings, field, log.need_rate(), config)
        table = table_of(
            f"{fit.seconds:.0f} s, {fit.turning_rad_s:.2f} rad/s rms, condition {fit.condition:.0f}, residual "
            f"{1e3 * fit.residual_m_s2:.2f} mm/s^2; intervals of 95 %",
            "place", "axis", "believed (mm)", "found (mm)", "moved by (mm)", left=2,
        )  # fmt: skip
        for name, before, place, reach in zip(fit.names, fit.believed, fit.places, fit.reach, strict=True):
            for axis, was, value, half in zip("xyz", 1e3 * before, 1e3 * place, 1e3 * reach, strict=True):
                named = name if axis == "x" else ""
                table.add_row(named, axis, f"{was:.2f}", f"{value:.3f} +- {half:.3f}", f"{value - was:+.3f}")
        data_console().print(table)
        if out is not None:
            made_by = f"micron calibrate positions {recording} --bench {bench}"
            write_calibration(
                out,
                calibration_toml("sensor positions", made_by, {"sensing": {"positions_m": fit.places.tolist()}}),
            )
            console().print(f"written: {out}")
        write_json(
            {
                "format": 1,
                "positions_m": fit.places,
                "believed_m": fit.believed,
                "parameters": {
                    name: {"value": e.value, "low": e.low, "high": e.high} for name, e in fit.parameters.items()
                },
                "residual_m_s2": fit.residual_m_s2,
                "condition": fit.condition,
                "seconds": fit.seconds,
                "turning_rad_s": fit.turning_rad_s,
            },
            json_file,
        )
