"""Geometry of the manipulator from a scan: strokes of the stacks beside the tip's position (Ang 2004, ch. 6).

Found together: circle of the balls, shaft, three levers, how the star leans at neutral, and the rotation from the
body's frame to the manipulator's. What fixes each: levers the motion along the shaft, shaft length the drop of a
tilted tip, their ratio to the circle the lateral motion, the lean how the drop is tilted.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation
from scipy.stats import t as student

from firmware_py.actuation.config import ActuationConfig
from firmware_py.actuation.manipulator import star_tip
from hal.arrays import Array
from hal.npz import open_npz
from tools.calibrate.calibration_file import calibration_toml
from tools.calibrate.multi_position import Estimate, estimates_of
from tools.errors import InputError

LEAST_POSITIONS = 12
NAMES = ("ball_circle_mm", "shaft_mm", "lever_1", "lever_2", "lever_3", "lean_x_mrad", "lean_y_mrad")
NAMES += ("mount_x_deg", "mount_y_deg", "mount_z_deg")


@dataclass(frozen=True)
class ManipulatorFit:
    """Holds ``table`` for [actuation] of a calibration and ``parameters`` with 95 % intervals.

    The residuals of the tip are in um per axis (x, y, z of the body), after the fit and with the geometry before it."""

    table: dict[str, Any]
    parameters: dict[str, Estimate]
    residual_um: tuple[float, float, float]
    before_um: tuple[float, float, float]
    condition: float
    positions: int
    warnings: tuple[str, ...]


def load_scan(folder: Path) -> dict[str, Array]:
    """``stroke_um`` and ``tip_um``, both (n, 3), of a scan recording. ``InputError`` says what is wrong."""
    path = folder / "data.npz" if folder.is_dir() else folder
    try:
        with open_npz(path) as archive:
            data = {name: np.asarray(archive[name], dtype=np.float64) for name in archive.files}
    except (OSError, ValueError) as error:
        raise InputError(
            f"{path}: cannot be read as .npz ({error}); record one with the lab's 'manipulator'"
        ) from error
    for name in ("stroke_um", "tip_um"):
        if name not in data or data[name].ndim != 2 or data[name].shape[1] != 3:
            raise InputError(
                f"{path}: array '{name}' is missing or is not (n, 3); it needs a row of three numbers per position"
            )
        if not np.all(np.isfinite(data[name])):
            row = int(np.argwhere(~np.isfinite(data[name]))[0][0])
            raise InputError(f"{path}: '{name}' is not finite at position {row}")
    if len(data["tip_um"]) != len(data["stroke_um"]):
        raise InputError(
            f"{path}: {len(data['stroke_um'])} rows of strokes and {len(data['tip_um'])} tip positions; each row"
            " needs the tip position that was measured with it"
        )
    return data


def tip_um(p: Array, stroke_um: Array) -> Array:
    """(n, 3) tip in the body frame, um, for parameters ``p`` (10,) in the order of ``NAMES``."""
    circle_m, shaft_m = p[0] * 1e-3, p[1] * 1e-3
    rest = rest_heights(circle_m, p[5] * 1e-3, p[6] * 1e-3)
    at, zero = np.empty((len(stroke_um), 3)), np.empty(3)
    star_tip(rest, circle_m, shaft_m, zero)
    for k, heights in enumerate(rest + p[2:5] * stroke_um * 1e-6):
        star_tip(heights, circle_m, shaft_m, at[k])
    turn: Array = np.asarray(Rotation.from_rotvec(np.radians(p[7:])).as_matrix())
    return 1e6 * (at - zero) @ turn.T


def rest_heights(circle_m: float, ax: float, ay: float) -> Array:
    """(3,) ball heights of a star whose shaft leans by (a_x, a_y); their mean does not show and is zero."""
    half = 0.5 * np.sqrt(3.0)
    return circle_m * np.array([-ax, 0.5 * ax - half * ay, 0.5 * ax + half * ay])


def identify_manipulator(data: dict[str, Array]) -> ManipulatorFit:
    """Fit all ten parameters to columns ``stroke_um`` and ``tip_um`` (n, 3) of a scan.

    Raises ``InputError`` when the scan does not determine them."""
    config = ActuationConfig()
    stroke, tip = data["stroke_um"], data["tip_um"]
    if len(tip) < LEAST_POSITIONS:
        raise InputError(f"{len(tip)} positions: at least {LEAST_POSITIONS} are needed, a grid of 3 x 3 x 3 is better")
    p0 = np.array([1e3 * config.ball_circle_m, 1e3 * config.shaft_m, *config.lever_gain, 0.0, 0.0, 0.0, 0.0, 0.0])

    def residuals(p: Array) -> Array:
        # a common zero of the tracker is no geometry
        e = tip - tip_um(p, stroke)
        return (e - e.mean(axis=0)).ravel()

    scale = np.array([1.0, 10.0, 1.0, 1.0, 1.0, 1.0, 1.0, 0.5, 0.5, 0.5])
    solution: Any = least_squares(residuals, p0, x_scale=scale, method="lm")
    jacobian = np.asarray(solution.jac) * scale
    singular = np.linalg.svd(jacobian, compute_uv=False)
    condition = float(singular[0] / singular[-1]) if singular[-1] > 0.0 else float("inf")
    if condition > 1e5:
        raise InputError(
            f"the scan does not fix the geometry (condition {condition:.1g}): move every stack over most of its range, "
            "also against each other"
        )
    free = tip.size - len(p0) - 3
    sigma = np.sqrt(2.0 * solution.cost / free)
    spread = scale * np.sqrt(np.diag(np.linalg.inv(jacobian.T @ jacobian))) * sigma
    width = float(student.ppf(0.975, free)) * spread
    p: Array = np.asarray(solution.x)
    before, after = residuals(p0).reshape(-1, 3), residuals(p).reshape(-1, 3)
    return ManipulatorFit(
        table=_table(p),
        parameters=estimates_of(NAMES, p, width),
        residual_um=_rms(after),
        before_um=_rms(before),
        condition=condition,
        positions=len(tip),
        warnings=_weak(tip, width),
    )


def _rms(e: Array) -> tuple[float, float, float]:
    x, y, z = np.sqrt(np.mean(e**2, axis=0))
    return float(x), float(y), float(z)


def _table(p: Array) -> dict[str, Any]:
    turn: Array = np.asarray(Rotation.from_rotvec(np.radians(p[7:])).as_matrix())
    return {
        "ball_circle_m": float(p[0] * 1e-3),
        "shaft_m": float(p[1] * 1e-3),
        "lever_gain": [float(v) for v in p[2:5]],
        "rest_heights_m": [float(v) for v in rest_heights(p[0] * 1e-3, p[5] * 1e-3, p[6] * 1e-3)],
        # rows are the manipulator's axes in the body frame
        "mounting": [[float(v) for v in row] for row in turn.T],
    }


def _weak(tip: Array, width: Array) -> tuple[str, ...]:
    problems = []
    for axis, name, least in ((0, "x", 300.0), (1, "y", 300.0), (2, "z", 30.0)):
        if np.ptp(tip[:, axis]) < least:
            problems.append(f"the tip moved only {np.ptp(tip[:, axis]):.0f} um along {name}: use more of the range")
    if width[1] > 1.0:
        problems.append(f"shaft length is known to {width[1]:.1f} mm only: average longer or move further sideways")
    return tuple(problems)


def manipulator_calibration(fit: ManipulatorFit, title: str) -> str:
    """Return the calibration file for the firmware."""
    return calibration_toml(title, "micron calibrate manipulator", {"actuation": fit.table})
