"""Implements ``micron calibrate``: it makes the files that a bench names under [firmware] calibration."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from tools.cli import calibrate_actuation, calibrate_axes, calibrate_gyroscope, calibrate_positions
from tools.cli.calibrate_actuation import Out
from tools.cli.calibrate_axes import Gravity, Model, OnDrift
from tools.cli.common import JsonOption, clear_errors, console
from tools.output import check_writable, write_calibration, write_json
from tools.terminal import table_of

calibrate = typer.Typer(help="Identify sensors and stacks from calibration recordings.")

calibrate.command("accelerometer")(calibrate_axes.accelerometer)
calibrate.command("magnetometer")(calibrate_axes.magnetometer)
calibrate.command("gyroscope")(calibrate_gyroscope.gyroscope)
calibrate.command("positions")(calibrate_positions.positions)
calibrate.command("piezo")(calibrate_actuation.piezo)
calibrate.command("manipulator")(calibrate_actuation.manipulator)


@calibrate.command("sensors")
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
    from tools.calibrate.calibration_file import calibration_toml
    from tools.calibrate.tumble import SENSORS, identify, load_tumble

    with clear_errors():
        check_writable(json_file, out)
        result = identify(load_tumble(recording), quadratic=model is Model.COMPOSITE, fit_drift=drift is OnDrift.FIT)
        made_by = f"micron calibrate sensors {recording}"
        write_calibration(
            out, calibration_toml("sensors", made_by, {"sensing": {**result.table, "gravity_m_s2": gravity}})
        )
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
