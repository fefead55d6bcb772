"""``micron reproduce real-sensors``: published figures of public recordings beside ours.

The recordings lie beside the project (``../shared/data``, or the folder that MICRON_DATA names); a set that is not
there is left out with a note.
"""

from __future__ import annotations

import os
import tomllib
from pathlib import Path
from typing import Any

import numpy as np

from tools.calibrate.ellipsoid import fit_ellipsoid
from tools.calibrate.gyroscope import fit_gyroscope
from tools.calibrate.logs import load_log
from tools.calibrate.multi_position import fit_poses, identify_poses
from tools.calibrate.still import quiet_level
from tools.noise.allan import allan_curve
from tools.reproduce.orientation_error import east_north_up, rms_errors_deg
from tools.reproduce.rows import Row, Table, build

ACCELEROMETER = ("acc_x_raw", "acc_y_raw", "acc_z_raw")
GYROSCOPE = ("gyro_x_raw", "gyro_y_raw", "gyro_z_raw")
BROAD_HZ = 1.0 / 0.0035


def data_folder() -> Path:
    """Where the public recordings are."""
    given = os.environ.get("MICRON_DATA")
    return Path(given) if given else Path(__file__).resolve().parents[3] / "shared" / "data"


def _meta(name: str) -> dict[str, Any]:
    return tomllib.loads((data_folder() / name / "meta.toml").read_text())


def xsens() -> list[Row]:
    """Accelerometer of an Xsens MTi from still poses."""
    log = load_log(data_folder() / "imu_tk_xsens")
    factory = _meta("imu_tk_xsens")["reference_factory"]
    result = identify_poses(log.matrix(ACCELEROMETER), log.need_rate(), 9.81744)
    source, condition = "imu_tk, Xsens MTi (factory)", f"{result.poses} poses, |g| = 9.81744 m/s^2"
    rows = [
        Row(source, "residual of |a|", "m/s^2", condition, 0.0135, result.residual_m_s2, "lower", "recording"),
        Row(
            "imu_tk, Xsens MTi (own nine-parameter fit)",
            "residual of |a|",
            "m/s^2",
            condition,
            0.0010,
            result.residual_m_s2,
            "lower",
            "recording",
        ),
    ]
    for i, axis in enumerate("xyz"):
        scale = factory["acc_scale_count_per_m_s2"][i]
        rows += [
            Row(
                source,
                f"scale {axis}",
                "count/(m/s^2)",
                condition,
                float(scale),
                1.0 / result.parameters[f"scale_{axis}"].value,
                "equal",
                "recording",
                tolerance=1.0,
                why="printed to three digits",
            ),
            # the factory's own |a| scatters by 0.0135 m/s^2 over these poses: that much of an offset is within it
            Row(
                source,
                f"offset {axis}",
                "count",
                condition,
                float(factory["acc_offset_count"][i]),
                result.parameters[f"bias_{axis}"].value,
                "equal",
                "recording",
                tolerance=0.0135 * scale,
                why="within the factory calibration's own scatter on these poses, 0.0135 m/s^2",
            ),
        ]
    return rows


def mpu6050() -> list[Row]:
    """Accelerometer of an MPU-6050 from ten poses: those that we find, and the author's, three of them under 0.3 s."""
    log = load_log(data_folder() / "mpu6050_tomisuarez" / "calibration.npz", 100.0)
    meta = _meta("mpu6050_tomisuarez")
    reference, intervals = meta["reference_accelerometer"], meta["reference_static_intervals"]
    raw = log.matrix(ACCELEROMETER)
    found = identify_poses(raw, 100.0, 9.80665)
    bounds = list(zip(intervals["start_sample"], intervals["stop_sample"], strict=True))
    mean = np.array([raw[a : b + 1].mean(axis=0) for a, b in bounds])
    samples = np.array([b + 1 - a for a, b in bounds], dtype=np.float64)
    noise = quiet_level(raw, 50) / np.sqrt(3.0 * np.median(samples))
    result = fit_poses(mean, np.minimum(samples, 200.0), 9.80665, pose_noise=float(noise))
    source, condition = "tomisuarez2/ImuCalibration, MPU-6050", "the author's own ten intervals"
    published = reference["magnitude_calibrated_m_s2"][1]
    rows = [
        Row(source, "residual of |a|", "m/s^2", what, published, fit.residual_m_s2, "lower", "recording")
        for what, fit in ((f"{found.poses} poses found", found), (condition, result))
    ]
    for i, axis in enumerate("xyz"):
        scale, bias = result.parameters[f"scale_{axis}"], result.parameters[f"bias_{axis}"]
        rows += [
            Row(
                source,
                f"scale {axis}",
                "m/s^2 per count",
                condition,
                reference["scale_m_s2_per_count"][i],
                scale.value,
                "equal",
                "recording",
                # 0.0042 m/s^2 of 9.80665: the scatter that the published calibration leaves
                tolerance=reference["scale_m_s2_per_count"][i] * published / 9.80665,
                why="within the published calibration's own scatter, 0.0042 m/s^2",
            ),
            Row(
                source,
                f"bias {axis} (to be taken off)",
                "count",
                condition,
                -reference["bias_count"][i],
                bias.value,
                "equal",
                "recording",
                tolerance=published / reference["scale_m_s2_per_count"][i],
                why="nine parameters from ten poses; ours hold the misalignments at a data sheet's 2 %",
            ),
        ]
    return rows


SATURATED = "in two turns the gyroscope is at its end; with them, as the author has it, the x scale rises (rows below)"


def gyroscopes() -> list[Row]:
    """Scale of two gyroscopes from still poses and the turns between them (Tedaldi sec. V)."""
    rows = []
    xsens_factory = [1.0 / v for v in _meta("imu_tk_xsens")["reference_factory"]["gyro_scale_count_per_rad_s"]]
    mpu = _meta("mpu6050_tomisuarez")["reference_gyroscope"]["scale_rad_s_per_count"]
    author = "tomisuarez2/ImuCalibration, MPU-6050"
    cheap = "mpu6050_tomisuarez/calibration.npz"
    for source, file, rate_hz, gravity, published, keep in (
        ("imu_tk, Xsens MTi (factory)", "imu_tk_xsens", None, 9.81744, xsens_factory, False),
        (author, cheap, 100.0, 9.80665, mpu, False),
        (author, cheap, 100.0, 9.80665, mpu, True),
    ):
        log = load_log(data_folder() / file, rate_hz)
        force, turning = log.matrix(ACCELEROMETER), log.matrix(GYROSCOPE)
        fit = fit_gyroscope(force, turning, log.need_rate(), gravity, keep_saturated=keep)
        condition = (
            f"{fit.turns} turns between poses, {fit.saturated} saturated ones {'kept' if keep else 'left out'}; "
            f"gravity after a turn off by {np.degrees(fit.residual_rad):.2f} deg rms"
        )
        for i, axis in enumerate("xyz"):
            scale = fit.parameters[f"scale_{axis}"]
            interval = f"our 95 % interval is +-{100.0 * (scale.high / scale.value - 1.0):.2f} %"
            rows.append(
                Row(
                    source,
                    f"scale of gyroscope {axis}",
                    "rad/s per count",
                    condition,
                    published[i],
                    scale.value,
                    "equal",
                    "recording",
                    tolerance=scale.high - scale.value,
                    why=f"{interval}; {SATURATED}" if fit.saturated and not keep else interval,
                )
            )
    return rows


def adis16405() -> list[Row]:
    """Overlapping Allan variance of the x gyroscope of an ADIS16405."""
    reference = _meta("adis16405_static")["reference_allan_variance_gyro_x"]
    log = load_log(data_folder() / "adis16405_static")
    factors = np.round(np.array(reference["tau_s"]) * 100.0).astype(np.int64)
    curve = allan_curve(log.matrix(("gyro_x_raw",))[:, 0] * 0.05, 100.0, factors)
    rows = []
    for tau, published, deviation in zip(reference["tau_s"], reference["avar_deg2_s2"], curve.deviation, strict=True):
        text = f"{published:.10f}".rstrip("0")
        decimals = len(text.split(".")[1])
        rows.append(
            Row(
                "SMAC-Group avar, ADIS16405 imu1",
                f"Allan variance of gyroscope x at {tau:g} s",
                "deg^2/s^2",
                "10 000 s at 100 Hz, overlapping",
                published,
                float(deviation) ** 2,
                "equal",
                "recording",
                tolerance=0.5 * 10.0**-decimals,
                why="printed to two or three digits",
            )
        )
    return rows


def qmc5883l() -> list[Row]:
    """Norm of the calibrated field of a QMC5883L."""
    reference = _meta("mag_qmc5883l_tomisuarez")["reference_calibration"]
    rows = []
    for name in ("filtered", "noisy"):
        log = load_log(data_folder() / "mag_qmc5883l_tomisuarez" / f"{name}.npz", 50.0)
        result = fit_ellipsoid(log.matrix(("mag_x_raw", "mag_y_raw", "mag_z_raw")))
        mean, spread = reference[f"{name}_norm"]
        rows.append(
            Row(
                "tomisuarez2/MagnetometerCalibration, QMC5883L",
                f"spread of the norm over its mean, {name}",
                "1",
                f"{result.samples} samples, {result.outliers} rejected but counted here",
                spread / mean,
                result.norm_spread / result.norm_mean,
                "lower",
                "recording",
            )
        )
    return rows


def broad() -> list[Row]:
    """Orientation of four BROAD trials, one fixed setting, beside Madgwick, Mahony and the vqf package."""
    from firmware_py.sensing.gyroscope_attitude import gyroscope_attitude

    rows, totals = [], []
    for entry in _meta("broad")["files"]:
        with np.load(data_folder() / "broad" / entry["name"]) as archive:
            data = {name: np.asarray(archive[name]) for name in archive.files}

        def columns(*names: str, data: dict[str, np.ndarray] = data) -> np.ndarray:
            return np.stack([data[name] for name in names], axis=1).astype(np.float64)

        rate = columns("gyro_x_rad_s", "gyro_y_rad_s", "gyro_z_rad_s")
        force = columns("acc_x_m_s2", "acc_y_m_s2", "acc_z_m_s2")
        field = columns("mag_x_uT", "mag_y_uT", "mag_z_uT")
        truth = columns("opt_quat_w", "opt_quat_x", "opt_quat_y", "opt_quat_z")
        counts = data["movement"].astype(bool)
        errors = {
            method: rms_errors_deg(
                east_north_up(gyroscope_attitude(rate, force, field, BROAD_HZ, method)), truth, counts
            )
            for method in ("error-state", "quaternion-kalman")
        }
        total, _, inclination = errors["error-state"]
        totals.append(total)
        trial = f"trial {entry['name'][:2]}"
        peers = [
            ("Madgwick, best setting of this trial", entry["madgwick_best_rmse_deg"], total, "total"),
            ("Mahony, best setting of this trial", entry["mahony_best_rmse_deg"], total, "total"),
        ]
        vqf = _vqf(rate, force, field)
        if vqf is not None:
            theirs = rms_errors_deg(vqf, truth, counts)
            peers += [
                ("1.1 x vqf 2.1.2, run side by side", 1.1 * theirs[0], total, "total"),
                ("1.1 x vqf 2.1.2, run side by side", 1.1 * theirs[2], inclination, "inclination"),
            ]
        for peer, published, ours, what in peers:
            rows.append(
                Row(
                    f"BROAD, {peer}",
                    f"{what} error, {trial}",
                    "deg",
                    "gyroscope as rate source, error-state filter, one setting for all trials",
                    float(published),
                    ours,
                    "lower",
                    "recording",
                )
            )
        rows.append(
            Row(
                "quaternion Kalman filter of 000 on the same trial",
                f"total error of the default (error-state) against it, {trial}",
                "deg",
                "one setting for all trials",
                errors["quaternion-kalman"][0],
                total,
                "lower",
                "recording",
            )
        )
    rows.append(
        Row(
            "design survey, vqf over 30 trials",
            "mean total error",
            "deg",
            "four trials here, thirty there",
            2.43,
            float(np.mean(totals)),
            "lower",
            "recording",
        )
    )
    return rows


def _vqf(rate: np.ndarray, force: np.ndarray, field: np.ndarray) -> np.ndarray | None:
    """Quaternions (east-north-up) of the vqf package, or None when it is not installed (development extra)."""
    try:
        from vqf import VQF  # pyright: ignore[reportMissingImports]
    except ImportError:
        return None
    arrays = [np.ascontiguousarray(a) for a in (rate, force, field)]
    return np.asarray(VQF(1.0 / BROAD_HZ).updateBatch(*arrays)["quat9D"])


SETS = {
    "imu_tk_xsens": xsens,
    "mpu6050_tomisuarez": mpu6050,
    "adis16405_static": adis16405,
    "mag_qmc5883l_tomisuarez": qmc5883l,
    "broad": broad,
}


def table() -> Table:
    """All sets that are there."""
    there = {name: section for name, section in SETS.items() if (data_folder() / name).is_dir()}
    notes = [f"{data_folder() / name} is not there: left out" for name in SETS if name not in there]
    if all(name in there for name in ("imu_tk_xsens", "mpu6050_tomisuarez")):
        there["gyroscopes"] = gyroscopes
    return build("real-sensors", list(there.values()), notes)
