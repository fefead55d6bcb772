"""Implements ``micron calibrate gyroscope``, from the log that calibrates the accelerometer beside it."""

from __future__ import annotations

from math import degrees
from pathlib import Path
from typing import Annotated

import typer

from hal.types import STANDARD_GRAVITY
from tools.cli.calibrate_axes import Columns, Gravity, Rate, Result, print_parameters, three
from tools.cli.common import JsonOption, clear_errors
from tools.output import check_writable, write_calibration, write_json


def gyroscope(
    *,
    recording: Annotated[
        Path, typer.Argument(metavar="LOG", help="Still poses with hand turns between: both sensors' columns.")
    ],
    columns: Columns = "gyro_x_raw,gyro_y_raw,gyro_z_raw",
    accelerometer_columns: Columns = "acc_x_raw,acc_y_raw,acc_z_raw",
    gravity: Gravity = STANDARD_GRAVITY,
    rate_hz: Rate = None,
    shortest_s: Annotated[float, typer.Option(min=0.05, help="Shortest rest that is a pose.")] = 0.5,
    out: Result = None,
    json_file: JsonOption = None,
) -> None:
    """Fit scale, misalignment and bias of a gyroscope from still poses and the turns between them (Tedaldi).

    Example: micron calibrate gyroscope log.npz --gravity 9.81744
    """
    from dataclasses import asdict

    from tools.calibrate.calibration_file import calibration_toml
    from tools.calibrate.gyroscope import fit_gyroscope
    from tools.calibrate.logs import load_log

    with clear_errors():
        check_writable(json_file, out)
        log = load_log(recording, rate_hz)
        force, rate = log.matrix(three(accelerometer_columns)), log.matrix(three(columns))
        result = fit_gyroscope(force, rate, log.need_rate(), gravity, shortest_s)
        print_parameters(
            "gyroscope (rad/s per count, counts, rad)",
            result.parameters,
            [
                f"{result.turns} turns between {result.accelerometer.poses} poses, {result.saturated} left out because "
                f"the gyroscope saturates; gravity after a turn off by {degrees(result.residual_rad):.2f} deg rms, "
                f"condition {result.condition:.1f}",
                "missing poses: " + (", ".join(result.accelerometer.missing) or "none"),
            ],
            json_file,
        )
        if out is not None:
            values = {name: e.value for name, e in result.parameters.items()}
            made_by = f"micron calibrate gyroscope {recording}"
            write_calibration(out, calibration_toml("gyroscope", made_by, {"gyroscope": values}))
        write_json({"format": 1, **asdict(result)}, json_file)
