"""``micron reproduce real-sensors``: published figures of public recordings beside ours.

The recordings lie beside the project (``../shared/data``, or the folder that MICRON_DATA names); a set that is not
there is left out with a note.
"""

from __future__ import annotations

from importlib.util import find_spec
from math import floor, log10

import numpy as np

from hal.arrays import Array
from hal.types import STANDARD_GRAVITY
from tools.calibrate.ellipsoid import fit_ellipsoid
from tools.calibrate.gyroscope import fit_gyroscope, rate_matrix, turned_gravity
from tools.calibrate.logs import load_log
from tools.calibrate.multi_position import compensate, fit_poses, identify_poses
from tools.calibrate.still import quiet_level
from tools.errors import InputError
from tools.noise.allan import allan_curve
from tools.research.reproduce import broad
from tools.research.reproduce.recordings import data_folder, meta
from tools.research.reproduce.rows import Row, Table, build

ACCELEROMETER = ("acc_x_raw", "acc_y_raw", "acc_z_raw")
GYROSCOPE = ("gyro_x_raw", "gyro_y_raw", "gyro_z_raw")


def xsens() -> list[Row]:
    """Accelerometer of an Xsens MTi from still poses."""
    log = load_log(data_folder() / "imu_tk_xsens")
    about = meta("imu_tk_xsens")
    factory, own = about["reference_factory"], about["reference_own_fit"]["acc_scale_count_per_m_s2"]
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
                tolerance=0.5,
                why=f"printed to three digits; nine parameters fitted by those who collected the set give {own[i]:g}",
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
    about = meta("mpu6050_tomisuarez")
    reference, intervals = about["reference_accelerometer"], about["reference_static_intervals"]
    raw = log.matrix(ACCELEROMETER)
    found = identify_poses(raw, 100.0, STANDARD_GRAVITY)
    bounds = list(zip(intervals["start_sample"], intervals["stop_sample"], strict=True))
    mean = np.array([raw[a : b + 1].mean(axis=0) for a, b in bounds])
    samples = np.array([b + 1 - a for a, b in bounds], dtype=np.float64)
    noise = quiet_level(raw, 50) / np.sqrt(3.0 * np.median(samples))
    result = fit_poses(mean, np.minimum(samples, 200.0), STANDARD_GRAVITY, pose_noise=float(noise))
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
                tolerance=reference["scale_m_s2_per_count"][i] * published / STANDARD_GRAVITY,
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


def xsens_gyroscope() -> list[Row]:
    """Scale of the gyroscope of an Xsens MTi from still poses and the turns between them (Tedaldi sec. V).

    The factory prints no uncertainty, so its digits are the tolerance; the reason says how far both are apart.
    """
    log = load_log(data_folder() / "imu_tk_xsens")
    counts = meta("imu_tk_xsens")["reference_factory"]["gyro_scale_count_per_rad_s"]
    fit = fit_gyroscope(log.matrix(ACCELEROMETER), log.matrix(GYROSCOPE), log.need_rate(), 9.81744)
    rows = []
    for axis, count in zip("xyz", counts, strict=True):
        scale, published = fit.parameters[f"scale_{axis}"], 1.0 / count
        apart, interval = (100.0 * (v - 1.0) for v in (scale.value / published, scale.high / scale.value))
        rows.append(
            Row(
                "imu_tk, Xsens MTi (factory)",
                f"scale of gyroscope {axis}",
                "rad/s per count",
                f"{fit.turns} turns between poses; gravity after one off by {np.degrees(fit.residual_rad):.2f} deg rms",
                published,
                scale.value,
                "equal",
                "recording",
                tolerance=0.5 / count**2,
                why=f"{apart:+.2f} % apart; our 95 % interval is +-{interval:.2f} %",
            )
        )
    return rows


SLOW_LSB = 500.0
"""A sample whose rate is further from the rest than this belongs to a turn, counts."""
MARGIN = 50
"""Samples between a rest and what is taken for the turn."""


def gravity_after_turn_deg(gyroscope: Array, accelerometer: Array, force: Array, rate: Array) -> float:
    """Angle in deg between gravity as the gyroscope turns it over one turn and as the accelerometer sees it then.

    ``force``, ``rate`` (n, 3) counts at 100 Hz, resting at both ends, where the gyroscope's bias is taken.
    ``gyroscope`` (9,) and ``accelerometer`` (9,) as for ``rate_matrix`` and ``compensate``.
    """
    away = np.flatnonzero(np.abs(rate - np.median(rate, axis=0)).max(axis=1) > SLOW_LSB)
    start, stop = int(away[0]) - MARGIN, int(away[-1]) + MARGIN
    seen = np.stack([compensate(accelerometer, force[part]).mean(axis=0) for part in (slice(start), slice(stop, None))])
    up = seen / np.linalg.norm(seen, axis=1)[:, None]
    bias = np.concatenate([rate[:start], rate[stop:]]).mean(axis=0)
    bounds, turned = np.array([[start, stop]], dtype=np.int64), np.empty((1, 3))
    turned_gravity(rate, bounds, bias[None, :], (rate_matrix(gyroscope), 0.01), np.ascontiguousarray(up[:1]), turned)
    return float(np.degrees(np.arccos(np.clip(turned[0] @ up[1], -1.0, 1.0))))


def mpu6050_turn() -> list[Row]:
    """A turn that neither calibration has seen: gravity behind it by ours and by the author's.

    The author prints scales of the gyroscope without an uncertainty; here both calibrations are put to the same test.
    """
    folder, about = data_folder() / "mpu6050_tomisuarez", meta("mpu6050_tomisuarez")
    log, turn = (load_log(folder / f"{name}.npz", 100.0) for name in ("calibration", "rotation_90_x"))
    force, rate = np.ascontiguousarray(turn.matrix(ACCELEROMETER)), np.ascontiguousarray(turn.matrix(GYROSCOPE))
    still, turning = about["reference_accelerometer"], about["reference_gyroscope"]
    scales = np.array(turning["scale_rad_s_per_count"])
    author = gravity_after_turn_deg(
        np.concatenate([turning["misalignment"], scales]),
        np.concatenate([still["misalignment"], still["scale_m_s2_per_count"], -np.array(still["bias_count"])]),
        force,
        rate,
    )
    rows = []
    for keep in (False, True):
        fit = fit_gyroscope(
            log.matrix(ACCELEROMETER), log.matrix(GYROSCOPE), 100.0, STANDARD_GRAVITY, keep_saturated=keep
        )
        percent = 100.0 * (fit.values()[6:] / scales - 1.0)
        apart = ", ".join(f"{axis} {by:+.2f} %" for axis, by in zip("xyz", percent, strict=True))
        rows.append(
            Row(
                "tomisuarez2/ImuCalibration, MPU-6050 (the author's calibration)",
                "gravity after a quarter turn about x that no fit has seen, off by",
                "deg",
                f"{fit.turns} turns between poses, {fit.saturated} saturated ones {'kept' if keep else 'left out'}; "
                f"scales against the printed ones: {apart}",
                author,
                gravity_after_turn_deg(fit.values(), fit.accelerometer.values(), force, rate),
                "lower",
                "recording",
            )
        )
    return rows


def allan_digit(value: float) -> float:
    """Return the last printed digit of a value of that table: 0.01 stands for 0.0100, 5e-5 for 0.000050."""
    return 10.0 ** max(floor(log10(value)) - 2, -6)


def adis16405() -> list[Row]:
    """Overlapping Allan variance of the x gyroscope of an ADIS16405."""
    reference = meta("adis16405_static")["reference_allan_variance_gyro_x"]
    log = load_log(data_folder() / "adis16405_static")
    factors = np.round(np.array(reference["tau_s"]) * 100.0).astype(np.int64)
    curve = allan_curve(log.matrix(("gyro_x_raw",))[:, 0] * 0.05, 100.0, factors)
    rows = []
    for tau, published, deviation in zip(reference["tau_s"], reference["avar_deg2_s2"], curve.deviation, strict=True):
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
                tolerance=0.5 * allan_digit(published),
                why="printed to three significant digits, at most six decimals",
            )
        )
    return rows


def qmc5883l() -> list[Row]:
    """Norm of the calibrated field of a QMC5883L."""
    reference = meta("mag_qmc5883l_tomisuarez")["reference_calibration"]
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


SETS = {
    "imu_tk_xsens": lambda: [*xsens(), *xsens_gyroscope()],
    "mpu6050_tomisuarez": lambda: [*mpu6050(), *mpu6050_turn()],
    "adis16405_static": adis16405,
    "mag_qmc5883l_tomisuarez": qmc5883l,
    "broad": broad.rows,
    broad.NOT_GIVEN: broad.rows_not_given,
}


def check() -> None:
    """``InputError`` when none of the recordings is there."""
    folder = data_folder()
    if not any((folder / name).is_dir() for name in SETS):
        raise InputError(
            f"real-sensors compares public recordings, and none is in {folder}: put {', '.join(SETS)} there, "
            "or name their folder in the environment variable MICRON_DATA"
        )


def table() -> Table:
    """Return the table of all existing sets. Raises ``InputError`` without any."""
    check()
    existing = {name: section for name, section in SETS.items() if (data_folder() / name).is_dir()}
    notes = [f"{data_folder() / name} is not there: left out" for name in SETS if name not in existing]
    if "broad" in existing and find_spec("vqf") is None:
        notes.append("the vqf package (development extra) is not installed: its rows are left out")
    if broad.NOT_GIVEN in existing:
        notes += broad.NOTES
    return build("real-sensors", list(existing.values()), notes)
