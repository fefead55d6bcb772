"""``micron calibrate``: from calibration recordings to the files that a bench names under [firmware] calibration."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer
from rich.table import Table

from tools.cli import calibrate_axes
from tools.cli.common import JsonOption, check_writable, clear_errors, console, write_json, write_text_atomic

calibrate = typer.Typer(no_args_is_help=True, help="Identify sensors and stacks from calibration recordings.")

calibrate.command("accelerometer")(calibrate_axes.accelerometer)
calibrate.command("magnetometer")(calibrate_axes.magnetometer)

Out = Annotated[Path, typer.Option("--out", metavar="FILE", help="Calibration file (TOML) that a bench can name.")]


@calibrate.command("sensors")
def sensors(
    recording: Annotated[Path, typer.Argument(metavar="TUMBLE", help="Folder or .npz of a tumble in known attitudes.")],
    out: Out,
    gravity: Annotated[float, typer.Option(help="Local gravity, m/s^2.")] = 9.80131,
    json_file: JsonOption = None,
) -> None:
    """Bias, scale and direction of every sensor axis from a resting instrument in many known attitudes.

    Example: micron calibrate sensors out/tumble --out out/sensors.toml
    """
    from tools.calibrate.calibration_file import calibration_toml
    from tools.calibrate.tumble import identify, load_tumble

    with clear_errors():
        check_writable(json_file, out)
        result = identify(load_tumble(recording))
        made_by = f"micron calibrate sensors {recording}"
        write_text_atomic(
            out, calibration_toml("sensors", made_by, {"sensing": {**result.table, "gravity_m_s2": gravity}})
        )
        table = Table(title=f"{result.positions} positions, condition {result.condition:.1f}", title_justify="left")
        for column in ("axis", "bias (V)", "scale (V/g)", "residual rms (mV)"):
            table.add_column(column, justify="right")
        for i, axis in enumerate(("1x", "1z", "2y", "2z", "3x", "3y")):
            table.add_row(
                axis,
                f"{result.table['bias_V'][i]:.4f}",
                f"{result.table['scale_V_per_g'][i]:.4f}",
                f"{1e3 * result.residual_V[axis]:.3f}",
            )
        console().print(table)
        console().print(f"written: {out}")
        write_json({"format": 1, "out": str(out), **result.as_dict()}, json_file)


@calibrate.command("piezo")
def piezo(
    recordings: Annotated[
        list[Path], typer.Argument(metavar="RECORDING...", help="One recording, or one per stack in the order 1, 2, 3.")
    ],
    out: Out,
    json_file: JsonOption = None,
) -> None:
    """Prandtl-Ishlinskii model of each stack from drive and displacement, checked on the part that no fit saw.

    Example: micron calibrate piezo out/stack0 out/stack1 out/stack2 --out out/piezo.toml
    """
    from dataclasses import asdict

    from tools.calibrate.piezo import identify_stack, piezo_calibration
    from tools.mismatch.recording import load

    with clear_errors():
        check_writable(json_file, out)
        fits = [identify_stack(load(path)) for path in recordings]
        write_text_atomic(out, piezo_calibration(fits, "piezo stacks"))
        table = Table(title="Piezo stacks, residuals on the held-out part", title_justify="left")
        for column in ("recording", "range (um)", "line rms (um)", "model rms (um)", "model max (um)", "lag (ms)"):
            table.add_column(column, justify="left" if column == "recording" else "right")
        for path, fit in zip(recordings, fits, strict=True):
            table.add_row(
                path.name,
                f"{fit.range_um:.2f}",
                f"{fit.linear_rms_um:.3f}",
                f"{fit.held_out_rms_um:.3f}",
                f"{fit.held_out_max_um:.3f}",
                f"{1e3 * fit.lag_s:.2f}",
            )
            for warning in fit.warnings:
                console().print(f"{path.name}: {warning}", soft_wrap=True)
        console().print(table)
        console().print(f"written: {out}")
        write_json({"format": 1, "out": str(out), "stacks": [asdict(fit) for fit in fits]}, json_file)
