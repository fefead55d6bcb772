"""Evaluates a sensor as chapter 5 of Erat 2018 does, from one motionless recording and others made for a method."""

from __future__ import annotations

from typing import Any

import numpy as np

from hal.types import STANDARD_GRAVITY
from tools.calibrate.quick import find_fall, inside_fall
from tools.errors import InputError
from tools.imu.offsets import gyroscope_mean, manual, moved, simple
from tools.imu.series import AXES, Array, Series, join_series
from tools.imu.stability import stability
from tools.imu.thermal import Thermal, thermal

SETTLE_S, MEAN_S = 10.0, 10.0
SHORTEST_S = 5.0
FLAT_G, FLAT_DPS = 0.003, 0.1
"""Changes over temperature that cannot be told from the instability of the sensors (Tables 5.4, 5.7)."""
ODD_GRAVITY = 0.15
SAME_POSE_G = 0.1


def evaluate_parts(parts: list[Series]) -> dict[str, Any]:
    """Evaluate one recording, or several of the same sensor at different temperatures: the first is judged, all
    together give the temperature dependence (of the accelerometer only if it lay in the same pose in all of them)."""
    result = evaluate_still(parts[0])
    if len(parts) == 1:
        return result
    for part in parts[1:]:
        _must_lie_still(part)
    means = np.array([part.accel_g.mean(axis=0) for part in parts])
    same_pose = float(np.max(np.ptp(means, axis=0))) < SAME_POSE_G
    warm = evaluate_thermal(join_series(parts), accelerometer=same_pose)
    if not same_pose:
        result["warnings"].append("the recordings show different poses: no temperature dependence of the accelerometer")
    return {**result, "thermal": warm}


def _must_lie_still(series: Series) -> None:
    if series.seconds < SHORTEST_S:
        raise InputError(
            f"{series.name}: {series.seconds:.1f} s are too short to judge a sensor; give {SHORTEST_S:g} s"
        )
    reason = moved(series)
    if reason is not None:
        raise InputError(f"{series.name}: it must lie still, but {reason}; --fall and --turned take other recordings")


def evaluate_still(series: Series) -> dict[str, Any]:
    """Compute offsets, Tables 5.4 to 5.8 and thermal stability.

    Offsets come from the 10 s after the first 10 s (a third of a shorter recording each), the rest is judged with them.
    ``InputError`` for a recording that is too short or was moved.
    """
    _must_lie_still(series)
    settle_s = min(SETTLE_S, series.seconds / 6.0)
    mean_s = min(MEAN_S, series.seconds / 6.0)
    head, rest = series.part(settle_s, settle_s + mean_s), series.part(settle_s + mean_s)
    accel = simple(head)
    gyro = None if series.gyro_dps is None else gyroscope_mean(head)
    found = stability(rest, accel, gyro)
    gravity = float(np.linalg.norm(series.accel_g.mean(axis=0)))
    result: dict[str, Any] = {
        "sensor": series.name,
        "rate_hz": series.rate_hz,
        "seconds": series.seconds,
        "lost": series.lost,
        "settle_s": settle_s,
        "mean_s": mean_s,
        "gravity_g": gravity,
        "offset": {"simple_g": _xyz(accel), "gyroscope_dps": None if gyro is None else _xyz(gyro)},
        "stability_g": {
            "max": _xyz(found.accel_max_g),
            "min": _xyz(found.accel_min_g),
            "difference": _xyz(found.accel_difference_g),
        },
        "drift_deg_per_min": {
            "before": None if found.drift_before_deg_min is None else _xyz(found.drift_before_deg_min),
            "after": None if found.drift_after_deg_min is None else _xyz(found.drift_after_deg_min),
        },
        "noise_rms_dps": None if found.noise_dps is None else _xyz(found.noise_dps),
        "thermal": evaluate_thermal(series),
        "warnings": [],
    }
    if abs(gravity - 1.0) > ODD_GRAVITY:
        result["warnings"].append(
            f"gravity reads {gravity:.3f} g: the range setting is probably wrong (a factor {1.0 / gravity:.2f})"
        )
    return result


def evaluate_thermal(series: Series, *, accelerometer: bool = True) -> dict[str, Any] | None:
    """Per axis slope, verdict and what a line takes away; None without 5 K of change."""
    if series.temperature_C is None:
        return None
    t = series.temperature_C
    rows: dict[str, Any] = {}
    for kind, data, flat in (
        ("accel", series.accel_g if accelerometer else None, FLAT_G),
        ("gyro", series.gyro_dps, FLAT_DPS),
    ):
        if data is None:
            continue
        for i, axis in enumerate(AXES):
            found = thermal(data[:, i], t, series.rate_hz, flat)
            if found is None:
                return None
            rows[f"{kind}_{axis}"] = _thermal_row(found, "g" if kind == "accel" else "deg/s")
    return {"lowest_C": float(np.min(t)), "highest_C": float(np.max(t)), "axes": rows}


def _thermal_row(found: Thermal, unit: str) -> dict[str, Any]:
    return {
        "unit": unit,
        "slope_per_K": found.slope,
        "ci95": [found.low, found.high],
        "change": found.change,
        "misfit": found.misfit,
        "rms_before": found.before,
        "rms_after": found.after,
        "verdict": found.verdict,
        "compensable": found.compensable,
    }


def evaluate_fall(series: Series) -> dict[str, Any]:
    """Compute zero-g offsets from a free fall from rest. ``InputError`` when nothing falls."""
    fall = find_fall(series.accel_g, series.rate_hz)
    if fall is None or fall[0] == 0 or fall[1] == len(series.accel_g):
        raise InputError(f"{series.name}: no free fall of 50 ms or more that begins and ends in the recording")
    seconds = (fall[1] - fall[0]) / series.rate_hz
    return {
        "sensor": series.name,
        "offset_g": _xyz(series.accel_g[inside_fall(fall)].mean(axis=0)),
        "start_s": fall[0] / series.rate_hz,
        "fall_s": seconds,
        "speed_m_s": STANDARD_GRAVITY * seconds,
    }


def evaluate_turned(series: Series) -> dict[str, Any]:
    """Offsets by the manual method, and by still poses at unknown angles where there are nine of them."""
    from tools.calibrate.multi_position import identify_poses

    found = manual(series)
    result: dict[str, Any] = {
        "sensor": series.name,
        "manual_g": _xyz(found.offset_g),
        "scale": _xyz(found.scale),
        "poles_missing": list(found.poles),
    }
    try:
        poses = identify_poses(series.accel_g, series.rate_hz, STANDARD_GRAVITY)
    except InputError:
        return {**result, "poses_g": None}
    names = ("bias_x", "bias_y", "bias_z")
    offset = {axis: poses.parameters[name].value for axis, name in zip(AXES, names, strict=True)}
    return {**result, "poses_g": offset, "poses": poses.poses, "poses_residual_m_s2": poses.residual_m_s2}


def _xyz(values: Array) -> dict[str, float]:
    return {axis: float(value) for axis, value in zip(AXES, values, strict=True)}
