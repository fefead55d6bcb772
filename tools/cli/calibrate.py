"""Implements ``micron calibrate``: it makes the files that a bench names under [firmware] calibration."""

from __future__ import annotations

from math import degrees
from pathlib import Path
from typing import Annotated

import typer

from hal.types import STANDARD_GRAVITY
from tools.cli import calibrate_axes
from tools.cli.bench_option import bench_path
from tools.cli.calibrate_actuation import Out, manipulator, piezo
from tools.cli.calibrate_axes import Columns, Gravity, Model, OnDrift, Rate, Result, three
from tools.cli.common import JsonOption, clear_errors, console, data_console
from tools.output import check_writable, write_json
from tools.terminal import table_of

calibrate = typer.Typer(help="Identify sensors and stacks from calibration recordings.")


def sensors(
    recording: Annotated[
        Path, typer.Argument(metavar="TUMBLE", help="Recording of the resting instrument on two rotary stages.")
    ],
    out: Out,
    gravity: Gravity = 9.80131,
    model: Annotated[Model, typer.Option(help="Model: with cross-axis bias and scale factor, or the line alone.")] = (
        Model.COMPOSITE
    ),
    drift: Annotated[
        OnDrift, typer.Option(help="What to do when the sensors still warm up: refuse or fit.")
    ] = OnDrift.REFUSE,
    json_file: JsonOption = None,
) -> None:
    """Fit bias, scale, direction and cross-axis terms of every sensor axis from a resting instrument in many attitudes.

    Example: micron calibrate sensors out/tumble --out out/sensors.toml
    """
    from tools.calibrate.calibration_file import save_calibration
    from tools.calibrate.tumble import SENSORS, identify, load_tumble

    with clear_errors():
        check_writable(json_file, out, reads=[recording])
        result = identify(load_tumble(recording), quadratic=model is Model.COMPOSITE, fit_drift=drift is OnDrift.FIT)
        made_by = f"micron calibrate sensors {recording}"
        save_calibration(out, "sensors", made_by, {"sensing": {**result.table, "gravity_m_s2": gravity}})
        table = table_of(
            f"{result.positions} positions, condition {result.condition:.1f}, intervals of 95 %; bias with in-plane "
            "and out-of-plane force in mg/g^2; rms of the line, of the model and of poses left out in mV",
            "axis", "bias (V)", "V/g", "in-plane", "out-of-plane", "line", "model", "left out",
            box=None, pad_edge=False, padding=(0, 1, 0, 0),
        )  # fmt: skip
        for name, axis in zip(SENSORS, result.accelerometers.axes, strict=True):
            cross = [axis.parameters[key] for key in ("in_plane_2", "out_of_plane_2")]
            bias = axis.parameters["bias_V"]
            table.add_row(
                name,
                f"{bias.value:.5f} +- {bias.high - bias.value:.5f}",
                f"{axis.scale_V_per_g:.5f}",
                *(f"{1e3 * e.value:.2f} +- {1e3 * (e.high - e.value):.2f}" for e in cross),
                *(f"{1e3 * rms:.3f}" for rms in (axis.linear_rms_V, axis.residual_rms_V, axis.held_out_rms_V)),
            )
        console().print(table)
        offset = result.magnetometer.offset_V
        console().print(
            f"magnetometer: residual {1e6 * result.magnetometer.residual_rms_V:.2f} uV rms; "
            + (
                "bridge offset from set and reset " + ", ".join(f"{1e3 * (e.value - 2.5):+.3f}" for e in offset) + " mV"
                if offset
                else "no reset pulses recorded: bridge offset and hard iron are one number"
            )
        )
        console().print("missing poses: " + (", ".join(result.accelerometers.missing) or "none"))
        console().print(f"written: {out}")
        write_json({"format": 1, "out": str(out), **result.as_dict()}, json_file)


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

    from tools.calibrate.calibration_file import save_calibration
    from tools.calibrate.gyroscope import fit_gyroscope
    from tools.calibrate.logs import load_log

    with clear_errors():
        check_writable(json_file, out, reads=[recording])
        log = load_log(recording, rate_hz)
        force, rate = log.matrix(three(accelerometer_columns)), log.matrix(three(columns))
        result = fit_gyroscope(force, rate, log.need_rate(), gravity, shortest_s)
        calibrate_axes.print_parameters(
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
        values = {name: e.value for name, e in result.parameters.items()}
        save_calibration(out, "gyroscope", f"micron calibrate gyroscope {recording}", {"gyroscope": values})
        write_json({"format": 1, **asdict(result)}, json_file)


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
    from tools.calibrate.calibration_file import save_calibration
    from tools.calibrate.instrument_log import bench_sensing, instrument_readings
    from tools.calibrate.logs import load_log
    from tools.calibrate.positions import fit_positions

    with clear_errors():
        check_writable(json_file, out, reads=[recording])
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
        made_by = f"micron calibrate positions {recording} --bench {bench}"
        save_calibration(out, "sensor positions", made_by, {"sensing": {"positions_m": fit.places.tolist()}})
        if out is not None:
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


for _command in (calibrate_axes.accelerometer, calibrate_axes.magnetometer, gyroscope, positions):
    calibrate.command()(_command)
for _command in (piezo, manipulator, sensors):
    calibrate.command()(_command)
