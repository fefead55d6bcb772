"""Chapter 5 of document 002 on the emulated chips, and what public recordings of such sensors are said to show."""

from __future__ import annotations

import tempfile
from pathlib import Path
from typing import Any

import benches
from firmware_py.endoscope.wiring import open_sensors
from hal.bench import load_bench, open_bench
from tools.imu.evaluate import evaluate_fall, evaluate_parts, evaluate_turned
from tools.imu.live import AutoCalibration, auto_calibrate, record
from tools.imu.offsets import gyroscope_mean
from tools.imu.series import AXES, Scales, load_series
from tools.imu.stability import stability
from tools.reproduce.real_sensors import data_folder
from tools.reproduce.rows import Row

WATCH_S = 120.0
PUBLISHED: dict[str, dict[str, tuple[float, float, float]]] = {
    "mpu6050": {
        "difference_g": (0.0154, 0.0159, 0.0264),
        "offset_dps": (2.1930, -1.5510, -1.8510),
        "before": (131.8779, -93.3726, -112.26),
        "after": (-0.1969, -0.3037, -0.9658),
        "noise_dps": (0.0288, 0.0328, 0.0367),
    },
    "bmx055": {
        "difference_g": (0.0117, 0.0107, 0.0146),
        "offset_dps": (-0.0737, -0.1362, -0.1157),
        "before": (-4.5574, -7.9445, -6.8093),
        "after": (-0.4753, 0.6906, 0.1190),
        "noise_dps": (0.0877, 0.0751, 0.0569),
    },
    "lsm6ds3": {
        "difference_g": (0.0078, 0.0037, 0.0109),  # ERRATA 117
        "offset_dps": (-1.8151, -6.5589, -1.8498),
        "before": (-109.4638, -396.7025, -112.1077),  # ERRATA 118
        "after": (-0.8509, 0.4860, -0.1431),
        "noise_dps": (0.0526, 0.0565, 0.0468),
    },
}


def _mean(values: Any) -> float:
    return sum(abs(float(v)) for v in values) / 3.0


def imus() -> list[Row]:
    """Tables 5.4 to 5.8, then recordings."""
    return [*_emulated(), *_recordings()]


def _emulated() -> list[Row]:
    rows: list[Row] = []
    bench = load_bench(Path(benches.__file__).with_name("imus.toml"))
    with (
        tempfile.TemporaryDirectory(prefix="micron-") as folder,
        open_bench(bench, pace="virtual", runtime_dir=Path(folder)) as opened,
    ):
        sensors = open_sensors(opened)
        sensors.start()
        for name, sensor in sensors.by_name.items():
            published = PUBLISHED[name]
            calibration = auto_calibrate(sensor, opened.clock)
            series = record(sensor, opened.clock, WATCH_S)
            # the registers have the offset: nothing is taken off here
            found = stability(series, series.accel_g.mean(axis=0) * 0.0, gyroscope_mean(series) * 0.0)
            assert found.drift_after_deg_min is not None
            assert found.noise_dps is not None
            condition = f"emulated {name.upper()} from its data sheet, +-2 g, +-2000 deg/s, {sensor.rate_hz:g} Hz"
            rows += [
                Row(
                    "002, Table 5.4",
                    f"peak to peak of the accelerometer at rest, {name}, mean of axes",
                    "g",
                    condition + ", 2 min",
                    _mean(published["difference_g"]),
                    _mean(found.accel_difference_g),
                    "equal",
                    "emulated",
                    tolerance=0.5 * _mean(published["difference_g"]),
                    why="another specimen: axes of one published chip differ by up to a factor 3; 10 min there",
                ),
                Row(
                    "002, Tables 5.5, 5.6",
                    f"drift per minute over offset, {name}",
                    "s",
                    "largest axis; 60 s by arithmetic",
                    *_drift_per_offset(published, calibration, found.drift_after_deg_min),
                    "equal",
                    "emulated",
                    tolerance=2.0,
                    why="printed cells differ from 60 times the offset by up to 3 % (ERRATA 118)",
                ),
                Row(
                    "002, Table 5.7",
                    f"largest drift after auto-calibration, {name}",
                    "deg/min",
                    condition + ", 10 s settled, 10 s mean, written to the chip",
                    1.0,
                    max(abs(float(v)) for v in found.drift_after_deg_min),
                    "lower",
                    "emulated",
                    why="printed: less than 1 degree per minute for all sensors"
                    + (
                        "; the chip's offset register has steps of 0.061 deg/s, half of one is 1.8 deg/min"
                        if name == "bmx055"
                        else ""
                    ),
                ),
                Row(
                    "002, Table 5.8",
                    f"rms noise of the gyroscope, {name}, mean of axes",
                    "deg/s",
                    condition,
                    _mean(published["noise_dps"]),
                    _mean(found.noise_dps),
                    "equal",
                    "emulated",
                    tolerance=0.3 * _mean(published["noise_dps"]),
                    why="data sheet density x root bandwidth; the filter setting of the document is not printed",
                ),
            ]
    return rows


def _drift_per_offset(
    published: dict[str, tuple[float, float, float]], calibration: AutoCalibration, left: Any
) -> tuple[float, float]:
    """Published and ours: deg per minute over deg per second, on the axis with the largest offset.

    Without what was written to its registers the chip would have drifted by that much more.
    """
    found = calibration.found_dps
    i = max(range(3), key=lambda k: abs(published["offset_dps"][k]))
    j = max(range(3), key=lambda k: abs(found[k]))
    ours = (float(left[j]) - 60.0 * calibration.written_dps[j]) / found[j]
    return published["before"][i] / published["offset_dps"][i], ours


def _recordings() -> list[Row]:
    rows: list[Row] = []
    folder = data_folder()
    if (folder / "bmi270_thermal").is_dir():
        parts = [load_series(folder / "bmi270_thermal" / f"{n}.npz", Scales(accel_factor=4.0)) for n in ("cold", "hot")]
        axes = evaluate_parts(parts)["thermal"]["axes"]
        for axis, published in zip(AXES, (0.019127, 0.01286, -0.001489), strict=True):
            rows.append(
                Row(
                    "BMI270 thermal drift recordings (README)",
                    f"temperature coefficient of the gyroscope, {axis}",
                    "deg/s/K",
                    "one line through 13 and 48 degC",
                    published,
                    axes[f"gyro_{axis}"]["slope_per_K"],
                    "equal",
                    "recording",
                    tolerance=2e-5,
                )
            )
    if (folder / "impack_drop").is_dir():
        for name, published in (("2mps_sphere_1_acc", 0.204), ("4mps_sphere_1_acc", 0.398)):
            found = evaluate_fall(load_series(folder / "impack_drop" / f"{name}.npz"))
            rows.append(
                Row(
                    "IMpack drops",
                    f"time of free fall, {name[:4]}",
                    "s",
                    "free-fall method of 002, 5.2.1.2",
                    published,
                    found["fall_s"],
                    "equal",
                    "recording",
                    tolerance=0.010,
                )
            )
            for axis, offset in zip(AXES, (0.005, 0.009, 0.013), strict=True):
                rows.append(
                    Row(
                        "IMpack drops",
                        f"zero-g offset {axis}, {name[:4]}",
                        "g",
                        "mean while falling",
                        offset,
                        found["offset_g"][axis],
                        "equal",
                        "recording",
                        tolerance=0.0015,
                        why="printed for both drops together, to 1 mg",
                    )
                )
    if (folder / "mpu6050_tomisuarez").is_dir():
        log = load_series(folder / "mpu6050_tomisuarez" / "calibration.npz", Scales(16384.0, 131.0))
        turned = evaluate_turned(log)
        for axis, count in zip(AXES, (711.516, -358.505, -1840.128), strict=True):
            for key, method, tolerance in (("poses_g", "still poses", 0.002), ("manual_g", "manual, extremes", 0.005)):
                rows.append(
                    Row(
                        "MPU-6050 calibration log (tomisuarez2)",
                        f"accelerometer offset {axis}, {method}",
                        "g",
                        "ten hand-held poses",
                        count / 16384.0,
                        turned[key][axis],
                        "equal",
                        "recording",
                        tolerance=tolerance,
                    )
                )
    return rows
