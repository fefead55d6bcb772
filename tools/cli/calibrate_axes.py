"""Implements ``micron calibrate accelerometer`` and ``magnetometer``, for three-axis sensors."""

from __future__ import annotations

from dataclasses import asdict
from enum import StrEnum
from pathlib import Path
from typing import Annotated

import typer

from hal.types import STANDARD_GRAVITY
from tools.cli.common import JsonOption, clear_errors, data_console
from tools.errors import InputError
from tools.output import check_writable, write_json
from tools.terminal import table_of


class Method(StrEnum):
    """Names the way in which the log was recorded."""

    POSES = "poses"
    STAGE = "stage"
    TURN = "turn"
    FALL = "fall"
    FLAT = "flat"


class OnDrift(StrEnum):
    """Names the answers to a sensor that still warms up."""

    REFUSE = "refuse"
    FIT = "fit"


class Model(StrEnum):
    """Names the parts of Ang 2004, sec. 3.2.1, that are identified."""

    COMPOSITE = "composite"
    LINEAR = "linear"


Columns = Annotated[str, typer.Option(help="The three columns, with commas.")]
Gravity = Annotated[float, typer.Option(min=9.0, max=10.0, help="Local gravity, in m/s^2.")]
Rate = Annotated[float | None, typer.Option(min=1e-3, help="Sampling rate, if the file does not say.")]
Result = Annotated[Path | None, typer.Option("--out", metavar="FILE", help="Result as TOML.")]


def three(columns: str) -> tuple[str, str, str]:
    """Return the three names in one option, or raise ``InputError``."""
    names = tuple(name.strip() for name in columns.split(","))
    if len(names) != 3:
        raise InputError(f"--columns {columns}: give three names with commas between, for x, y and z")
    return names  # pyright: ignore[reportReturnType]


def print_parameters(title: str, parameters: dict, notes: list[str], json_file: str | None) -> None:
    """Print a table of estimates with their intervals, and notes; on standard error if JSON is on the other."""
    to = data_console(json_file)
    table = table_of(title, "parameter", "value", "95 % interval")
    for name, e in parameters.items():
        table.add_row(name, f"{e.value:.6g}", f"{e.low:.6g} .. {e.high:.6g}")
    to.print(table)
    for note in notes:
        to.print(note)


def accelerometer(
    *,
    recording: Annotated[
        Path,
        typer.Argument(metavar="RECORDING", help="Recording (folder, .toml, or a data file) with three columns."),
    ],
    method: Annotated[
        Method, typer.Option(help="Still poses at unknown angles, a rotary stage, or a quick method of Erat 2018.")
    ] = Method.POSES,
    model: Annotated[
        Model, typer.Option(help="Model of --method stage: with cross-axis terms, or the line alone.")
    ] = Model.COMPOSITE,
    columns: Columns = "acc_x_raw,acc_y_raw,acc_z_raw",
    gravity: Gravity = STANDARD_GRAVITY,
    rate_hz: Rate = None,
    counts_per_g: Annotated[
        float, typer.Option(min=1e-12, help="Nominal counts per g, for the methods fall and flat.")
    ] = 16384.0,
    up: Annotated[str, typer.Option(help="Axis that points up in a flat log.")] = "z",
    drift: Annotated[
        OnDrift, typer.Option(help="What to do when the sensor still warms up at the first rest: refuse or fit.")
    ] = OnDrift.REFUSE,
    out: Result = None,
    json_file: JsonOption = None,
) -> None:
    """Fit bias, scale and misalignment of a three-axis accelerometer, with intervals, condition and missing poses.

    Example: micron calibrate accelerometer log.npz --gravity 9.81744

    Stage: micron calibrate accelerometer out/tumble --method stage --columns analog_V_4,analog_V_5,analog_V_1

    Quick: micron calibrate accelerometer flat.csv --method flat --up z --counts-per-g 16384
    """
    from tools.calibrate.calibration_file import save_calibration
    from tools.calibrate.logs import load_log
    from tools.calibrate.multi_position import MultiPosition, identify_poses
    from tools.calibrate.quick import flat, free_fall, turn
    from tools.calibrate.still import remove_drift

    with clear_errors():
        check_writable(json_file, out, reads=[recording])
        if method is Method.STAGE:
            _stage(recording, three(columns), model, drift, rate_hz=rate_hz, out=out, json_file=json_file)
            return
        log = load_log(recording, rate_hz)
        raw, rate = log.matrix(three(columns)), log.need_rate()
        # lying flat or falling its readings do not reach over 1 g: what 2 mg are is then said by --counts-per-g
        one_g = counts_per_g if method in (Method.FALL, Method.FLAT) else None
        raw, warm = remove_drift(raw, rate, allowed=drift is OnDrift.FIT, reach=one_g)
        notes = [warm.text()]
        if method is Method.POSES:
            result = identify_poses(raw, rate, gravity)
            notes.append(
                f"{result.poses} poses, |a| {result.mean_m_s2:.4f} m/s^2, "
                f"residual rms {result.residual_m_s2:.5f} m/s^2, condition {result.condition:.1f}"
            )
        elif method is Method.TURN:
            result = turn(raw)
        elif method is Method.FALL:
            result = free_fall(raw, rate, counts_per_g)
        else:
            result = flat(raw, counts_per_g, up)
        if not isinstance(result, MultiPosition):
            notes += result.lines()
        notes.append("missing: " + (", ".join(result.missing) or "nothing"))
        print_parameters(f"accelerometer, {method.value}", result.parameters, notes, json_file)
        values = {name: e.value for name, e in result.parameters.items()}
        save_calibration(out, "accelerometer", f"micron calibrate accelerometer {recording}", {"accelerometer": values})
        write_json({"format": 1, "method": method.value, **asdict(result), "warm_up": asdict(warm)}, json_file)


def _stage(
    recording: Path,
    columns: tuple[str, str, str],
    model: Model,
    drift: OnDrift,
    *,
    rate_hz: float | None,
    out: Path | None,
    json_file: str | None,
) -> None:
    """Calibrate three axes whose attitude two stages gave: x and y of one package, z of another (Ang 2004 sec.
    3.2.1.7)."""
    from tools.calibrate.calibration_file import save_calibration
    from tools.calibrate.composite import fit_composite
    from tools.calibrate.stage_log import load_stage_log
    from tools.calibrate.tumble import refuse_drift

    log = load_stage_log(recording, rate_hz)
    force = log.attitude[:, 2, :]
    fit = fit_composite(
        log.matrix(columns),
        force,
        (1, 0, 0),
        (2, 2, 1),
        quadratic=model is Model.COMPOSITE,
        fit_drift=drift is OnDrift.FIT,
    )
    if drift is OnDrift.REFUSE:
        refuse_drift(fit)
    notes = [
        f"{name}: residual rms {axis.residual_rms_V:.4g} V (line alone {axis.linear_rms_V:.4g}, poses left out "
        f"{axis.held_out_rms_V:.4g}), condition {axis.condition:.1f}"
        for name, axis in zip("xyz", fit.axes, strict=True)
    ]
    notes.append("missing: " + (", ".join(fit.missing) or "nothing"))
    named = {f"{n}.{k}": e for n, axis in zip("xyz", fit.axes, strict=True) for k, e in axis.parameters.items()}
    print_parameters(f"accelerometer, stage, {fit.poses} poses", named, notes, json_file)
    tables = {n: {k: e.value for k, e in axis.parameters.items()} for n, axis in zip("xyz", fit.axes, strict=True)}
    save_calibration(out, "accelerometer", f"micron calibrate accelerometer {recording} --method stage", tables)
    write_json({"format": 1, "method": "stage", **asdict(fit)}, json_file)


def magnetometer(
    recording: Annotated[Path, typer.Argument(metavar="RECORDING", help="Recording turned through all directions.")],
    columns: Columns = "mag_x_raw,mag_y_raw,mag_z_raw",
    reset_columns: Annotated[
        str | None, typer.Option(help="The same columns after a reset pulse; they remove the bridge's offset.")
    ] = None,
    accelerometer_columns: Annotated[
        str | None, typer.Option(help="Columns of a calibrated accelerometer; they give the rotation to the body.")
    ] = None,
    out: Result = None,
    json_file: JsonOption = None,
) -> None:
    """Fit hard and soft iron by an ellipsoid with outlier rejection: m = A (raw - b), |m| = 1; rotation to the body,
    offset.

    Example: micron calibrate magnetometer turned.npz

    With all: micron calibrate magnetometer log.npz --accelerometer-columns ax,ay,az --reset-columns rx,ry,rz
    """
    from tools.calibrate.calibration_file import save_calibration
    from tools.calibrate.ellipsoid import fit_ellipsoid
    from tools.calibrate.field_axes import fit_turn, strap
    from tools.calibrate.logs import load_log

    with clear_errors():
        check_writable(json_file, out, reads=[recording])
        log = load_log(recording, 1.0)
        raw, offset = log.matrix(three(columns)), None
        if reset_columns is not None:
            raw, offset = strap(raw, log.matrix(three(reset_columns)))
        result = fit_ellipsoid(raw)
        parameters, matrix, turn = dict(result.intervals), result.matrix, None
        notes = [
            f"norm {result.norm_mean:.4f} +/- {result.norm_spread:.4f} over {result.samples} samples, "
            f"{result.outliers} outliers ({result.kept_spread:.4f} without), condition {result.condition:.1f}",
            "missing: " + (", ".join(result.missing) or "nothing"),
        ]
        if offset is not None:
            parameters |= {f"bridge_offset_{axis}": e for axis, e in zip("xyz", offset, strict=True)}
            notes.append("b is hard iron alone: the bridge's offset is taken off")
        if accelerometer_columns is not None:
            turn = fit_turn(result.apply(raw), log.matrix(three(accelerometer_columns)))
            parameters |= turn.parameters
            matrix = turn.turn @ matrix
            notes.append(
                f"turn to the body from {turn.samples} samples at rest, residual {turn.residual:.4f}, "
                f"condition {turn.condition:.1f}; the matrix in --out holds it"
            )
        else:
            notes.append("the turn between magnetometer and body is not in these data: give --accelerometer-columns")
        print_parameters("magnetometer", parameters, notes, json_file)
        table = {"matrix": matrix.tolist(), "bias": result.bias.tolist()}
        if offset is not None:
            table["bridge_offset"] = [e.value for e in offset]
        save_calibration(out, "magnetometer", f"micron calibrate magnetometer {recording}", {"magnetometer": table})
        body = None if turn is None else asdict(turn)
        write_json(
            {"format": 1, **asdict(result), "bridge_offset": offset and [asdict(e) for e in offset], "body": body},
            json_file,
        )
