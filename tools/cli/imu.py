"""Implements ``micron imu``: it evaluates an inertial sensor from a recording or on the bench (Erat 2018, chapter
5)."""

from __future__ import annotations

import tempfile
from pathlib import Path
from typing import Annotated, Any

import typer
from rich.progress import BarColumn, TimeRemainingColumn

from tools.cli.bench_option import bench_path, pace_of
from tools.cli.common import Exit, JsonOption, check_picture, clear_errors, console, data_console
from tools.errors import InputError
from tools.imu.series import AXES, Series
from tools.output import check_writable, write_json
from tools.terminal import progress_bar, table_of, task_name


def imu(
    *,
    recording: Annotated[
        list[Path] | None,
        typer.Argument(metavar="[RECORDING]...", help="Motionless recordings; more than one for other temperatures."),
    ] = None,
    fall: Annotated[
        list[Path] | None, typer.Option("--fall", metavar="RECORDING", help="Recording of a free fall.")
    ] = None,
    turned: Annotated[
        Path | None,
        typer.Option("--turned", metavar="RECORDING", help="Recording turned slowly through all six directions."),
    ] = None,
    rate: Annotated[
        float | None,
        typer.Option("--rate-hz", min=0.1, help="Sampling rate, in Hz, of recordings without a time column."),
    ] = None,
    accel_lsb: Annotated[
        float | None, typer.Option("--accel-lsb-per-g", min=1e-9, help="Counts per g of raw columns.")
    ] = None,
    gyro_lsb: Annotated[
        float | None, typer.Option("--gyro-lsb-per-dps", min=1e-9, help="Counts per deg/s of raw columns.")
    ] = None,
    accel_factor: Annotated[
        float, typer.Option(min=1e-9, help="Factor that repairs a range error of the logger.")
    ] = 1.0,
    bench: Annotated[
        Path | None, typer.Option("--bench", metavar="FILE|NAME", help="Measure the sensors of a bench.")
    ] = None,
    sensor: Annotated[str | None, typer.Option("--sensor", help="Only this device of the bench.")] = None,
    virtual: Annotated[bool, typer.Option("--virtual", help="Virtual time (emulated bench).")] = False,
    seconds: Annotated[
        float, typer.Option(min=5.0, max=86_400.0, help="Time of the measurement on a bench, in s.")
    ] = 600.0,
    picture: Annotated[
        Path | None, typer.Option("--picture", metavar="FILE", help="Picture (PNG) of the first sensor.")
    ] = None,
    json_file: JsonOption = None,
) -> None:
    """Measure offsets, stability, drift, noise and temperature dependence of an inertial sensor, from recordings or on
    a bench.

    The tables are those of Erat 2018 (5.4 to 5.8). On a bench the sensors calibrate themselves first.

    Example: micron imu --bench imus --virtual --seconds 60
    """
    from tools.imu.evaluate import evaluate_fall, evaluate_parts, evaluate_turned
    from tools.imu.picture import save_imu_picture
    from tools.imu.series import Scales, load_series

    with clear_errors():
        check_writable(json_file, picture, reads=[*(recording or ()), *(fall or ()), turned, bench])
        check_picture(picture)
        if (bench is None) == (not recording and not fall and turned is None):
            raise InputError("give recordings, or --bench FILE to measure: one of the two")
        if picture is not None and bench is None and not recording:
            raise InputError("--picture shows a motionless recording; give one, or leave --picture out")
        result: dict[str, Any] = {"format": 1, "sensors": [], "falls": [], "turned": None}
        pictured: Series | None = None
        ok = True
        if bench is not None:
            series, result["sensors"] = _measure(bench, sensor, virtual, seconds)
            pictured = series[0]
            ok = all(r["auto_calibration"] is None or r["auto_calibration"]["verified"] for r in result["sensors"])
        else:
            scales = Scales(accel_lsb, gyro_lsb, accel_factor)
            if recording:
                parts = [load_series(path, scales, rate) for path in recording]
                pictured = parts[0]
                result["sensors"] = [{**evaluate_parts(parts), "auto_calibration": None}]
            result["falls"] = [evaluate_fall(load_series(path, scales, rate)) for path in fall or []]
            if turned is not None:
                result["turned"] = evaluate_turned(load_series(turned, scales, rate))
        for report in result["sensors"]:
            _show(report)
        _show_others(result)
        if picture is not None and pictured is not None:
            save_imu_picture(pictured, picture)
            console().print(f"picture: {picture}")
        write_json(result, json_file)
        if not ok:
            raise typer.Exit(Exit.FAILED)
        if any(r["lost"] for r in result["sensors"]):
            raise typer.Exit(Exit.DATA_LOST)


def _measure(bench: Path, only: str | None, virtual: bool, seconds: float) -> tuple[list[Series], list[dict[str, Any]]]:
    """Measure each sensor in turn: it calibrates itself, then it is recorded for ``seconds``."""
    from drivers.specs import check_devices
    from firmware_py.endoscope.wiring import open_sensors
    from hal.bench import load_bench, open_bench
    from tools.imu.evaluate import evaluate_still
    from tools.imu.live import auto_calibrate, record

    series: list[Series] = []
    report: list[dict[str, Any]] = []
    described = load_bench(bench_path(bench))
    check_devices(described.description, str(described.path))
    columns = (task_name(), BarColumn(), TimeRemainingColumn())
    with (
        tempfile.TemporaryDirectory(prefix="micron-") as folder,
        open_bench(described, pace=pace_of(virtual), runtime_dir=Path(folder)) as opened,
        progress_bar(console(), *columns) as bar,
    ):
        sensors = open_sensors(opened, only, may_drain=True)
        try:
            sensors.start()
            for name, device in sensors.by_name.items():
                calibrated = None
                task = bar.add_task(f"{name}: auto-calibration", total=1.0)

                def show(share: float, task: Any = task) -> None:
                    bar.update(task, completed=share)

                if device.imu is not None:
                    calibrated = auto_calibrate(device, opened.clock, progress=show)
                bar.update(task, description=f"{name}: watching", completed=0.0)
                # the sensor has settled; what evaluate_still takes for its own offsets comes first
                series.append(record(device, opened.clock, seconds, show))
                still = evaluate_still(series[-1])
                if calibrated is not None:
                    # before the calibration: what the chip showed without its registers
                    still["offset"] = {
                        "simple_g": dict(zip(AXES, calibrated.found_g, strict=True)),
                        "gyroscope_dps": dict(zip(AXES, calibrated.found_dps, strict=True)),
                    }
                    after = still["drift_deg_per_min"]["before"]
                    before = {a: after[a] - 60.0 * v for a, v in zip(AXES, calibrated.written_dps, strict=True)}
                    still["drift_deg_per_min"] = {"before": before, "after": after}
                report.append({**still, "auto_calibration": None if calibrated is None else calibrated.as_dict()})
        finally:
            sensors.close()
    return series, report


def _show(report: dict[str, Any]) -> None:
    title = (
        f"{report['sensor']}: {report['seconds']:.0f} s at {report['rate_hz']:g} Hz, |a| = {report['gravity_g']:.4f} g"
    )
    table = table_of(title, "Erat 2018", "quantity", *AXES, left=2)

    def row(source: str, what: str, values: dict[str, float] | None, form: str) -> None:
        if values is not None:
            table.add_row(source, what, *(format(values[a], form) for a in AXES))

    row("5.2.1.3", "accelerometer offset, simple (g)", report["offset"]["simple_g"], ".4f")
    for key in ("max", "min", "difference"):
        row("Table 5.4", f"accelerometer, {key} (g)", report["stability_g"][key], ".4f")
    row("Table 5.5", "gyroscope offset (deg/s)", report["offset"]["gyroscope_dps"], ".4f")
    row("Table 5.6", "drift before calibration (deg/min)", report["drift_deg_per_min"]["before"], ".2f")
    row("Table 5.7", "drift after calibration (deg/min)", report["drift_deg_per_min"]["after"], ".3f")
    row("Table 5.8", "gyroscope noise, rms (deg/s)", report["noise_rms_dps"], ".4f")
    data_console().print(table)
    calibrated = report["auto_calibration"]
    if calibrated is not None:
        left = max(abs(v) for v in calibrated["left_dps"])
        left_g = max(abs(v) for v in calibrated["left_g"])
        verdict = "verified" if calibrated["verified"] else "NOT within its limits"
        data_console().print(
            f"auto-calibration in the chip: {1e3 * left_g:.2f} mg and {left:.4f} deg/s left, {verdict}"
        )
    warm = report["thermal"]
    if warm is not None:
        title = f"temperature {warm['lowest_C']:.1f} .. {warm['highest_C']:.1f} degC"
        headings = ("axis", "slope per K", "change", "rms before", "rms after", "unit", "verdict")
        table = table_of(title, *headings, left=0)
        for name, axis in warm["axes"].items():
            figures = (axis["slope_per_K"], axis["change"], axis["rms_before"], axis["rms_after"])
            table.add_row(name, *(f"{v:.3g}" for v in figures), axis["unit"], axis["verdict"])
        data_console().print(table)
    for warning in report["warnings"]:
        console().print(f"{report['sensor']}: {warning}", style="yellow", soft_wrap=True)


def _show_others(result: dict[str, Any]) -> None:
    for fall in result["falls"]:
        x, y, z = (1e3 * fall["offset_g"][a] for a in AXES)
        data_console().print(
            f"{fall['sensor']}: free fall of {fall['fall_s']:.3f} s ({fall['speed_m_s']:.2f} m/s), "
            f"zero-g offset {x:.1f}, {y:.1f}, {z:.1f} mg",
            soft_wrap=True,
        )
    turned = result["turned"]
    if turned is not None:
        for key, what in (("manual_g", "manual (max, min)"), ("poses_g", "still poses")):
            if turned[key] is not None:
                x, y, z = (1e3 * turned[key][a] for a in AXES)
                data_console().print(f"{turned['sensor']}: offset {x:.1f}, {y:.1f}, {z:.1f} mg by {what}")
        if turned["poles_missing"]:
            missing = ", ".join(turned["poles_missing"])
            console().print(
                f"never pointed up: {missing}; the manual offsets of these axes mean nothing", style="yellow"
            )
