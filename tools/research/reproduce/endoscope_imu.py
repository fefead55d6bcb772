"""Chapter 5 of Erat 2018 on the emulated chips, and what public recordings of such sensors are said to show.

Tables 5.4 and 5.8 have no rows: they are the noise of three specimens whose filter settings are not printed, and
that of the emulated chips is the data sheets'.
"""

from __future__ import annotations

import tempfile
from pathlib import Path

import benches
from firmware_py.endoscope.wiring import open_sensors
from hal.bench import load_bench, open_bench
from hal.types import STANDARD_GRAVITY
from tools.imu.evaluate import evaluate_fall, evaluate_parts, evaluate_turned
from tools.imu.live import auto_calibrate, record
from tools.imu.offsets import gyroscope_mean
from tools.imu.series import AXES, Scales, load_series
from tools.imu.stability import stability
from tools.research.reproduce.recordings import data_folder, meta
from tools.research.reproduce.rows import Row

WATCH_S = 120.0
SCATTER_G = 0.0042 / STANDARD_GRAVITY
"""Standard deviation of |a| over the ten poses with the published calibration (meta.toml of the set)."""


def imus() -> list[Row]:
    """Table 5.7, then recordings."""
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
            auto_calibrate(sensor, opened.clock)
            series = record(sensor, opened.clock, WATCH_S)
            # the registers have the offset: nothing is taken off here
            found = stability(series, series.accel_g.mean(axis=0) * 0.0, gyroscope_mean(series) * 0.0)
            assert found.drift_after_deg_min is not None
            condition = f"emulated {name.upper()} from its data sheet, +-2 g, +-2000 deg/s, {sensor.rate_hz:g} Hz"
            rows += [
                Row(
                    "Erat 2018, Table 5.7",
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
            ]
    return rows


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
                    tolerance=5e-7,
                    why="printed to six decimals; ours is a line through means of 5 s, each as heavy as the other",
                )
            )
    if (folder / "impack_drop").is_dir():
        offsets: list[tuple[float, ...]] = []
        for name, speed in (("2mps_sphere_1_acc", 2.0), ("4mps_sphere_1_acc", 4.0)):
            found = evaluate_fall(load_series(folder / "impack_drop" / f"{name}.npz"))
            offsets.append(tuple(found["offset_g"][axis] for axis in AXES))
            rows.append(
                Row(
                    "IMpack drops (names of the files)",
                    f"speed at the impact, {name[:4]}",
                    "m/s",
                    "g times the time of free fall, free-fall method of Erat 2018, 5.2.1.2",
                    speed,
                    STANDARD_GRAVITY * found["fall_s"],
                    "equal",
                    "recording",
                    tolerance=0.5,
                    why="printed as one digit",
                )
            )
        reference = meta("impack_drop")["reference"]["free_fall_mean_vector_g"]
        for axis, published, ours in zip(AXES, reference, zip(*offsets, strict=True), strict=True):
            rows.append(
                Row(
                    "IMpack drops (computed by those who collected the set)",
                    f"zero-g offset {axis}",
                    "g",
                    "mean of two drops while falling",
                    float(published),
                    sum(ours) / len(ours),
                    "equal",
                    "recording",
                    tolerance=0.0005,
                    why=f"printed to 1 mg for both drops together; ours {ours[0]:.4f} and {ours[1]:.4f}",
                )
            )
    if (folder / "mpu6050_tomisuarez").is_dir():
        log = load_series(folder / "mpu6050_tomisuarez" / "calibration.npz", Scales(16384.0, 131.0))
        turned = evaluate_turned(log)
        for axis, count in zip(AXES, (711.516, -358.505, -1840.128), strict=True):
            for key, method in (("poses_g", "still poses"), ("manual_g", "manual, extremes")):
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
                        tolerance=SCATTER_G,
                        why="tolerance: what the published calibration leaves in |a| (0.0042 m/s^2); ten poses held by "
                        "hand do not reach the extremes",
                    )
                )
    return rows
