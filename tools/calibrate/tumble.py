"""Bias, scale and direction of every sensor axis from a resting instrument in many known attitudes.

At rest V / (supply / nominal) = bias + s . f, with f = C_WB^T (0, 0, g) (ERRATA 2): linear in bias and the
sensitivity vector s, whose length is the scale factor and whose direction is the axis with its misalignment
(000, sec. 3.2.1). The magnetometer measures a field of unknown size and direction: V = bias + M C_WB^T B, solved
by alternating least squares; only the product of M and B shows, so the mean scale is taken as nominal.
"""

from __future__ import annotations

from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from tools.cli.common import InputError

Array = NDArray[np.float64]
NOMINAL_SUPPLY_V = 5.0
NOMINAL_MAGNETOMETER_V_PER_UT = 0.01
SENSORS = ("1x", "1z", "2y", "2z", "3x", "3y")


@dataclass(frozen=True)
class TumbleResult:
    """What was identified: ``table`` for [sensing] of a calibration, residual rms per axis in V."""

    table: dict[str, Any]
    residual_V: dict[str, float]
    condition: float
    positions: int

    def as_dict(self) -> dict[str, Any]:
        """JSON values."""
        return asdict(self)


def load_tumble(folder: Path) -> dict[str, Array]:
    """Arrays of a tumble recording: ``attitude`` (n,3,3) body to world, ``analog_V`` (n,8), ``magnetometer_V``."""
    path = folder / "data.npz" if folder.is_dir() else folder
    try:
        with np.load(path, allow_pickle=False) as archive:
            data = {name: np.asarray(archive[name], dtype=np.float64) for name in archive.files}
    except (OSError, ValueError) as error:
        raise InputError(f"{path}: cannot be read as .npz ({error}); record one with the lab's 'tumble'") from error
    for name, shape in (("attitude", (3, 3)), ("analog_V", (8,)), ("magnetometer_V", (3,))):
        if name not in data or data[name].shape[1:] != shape:
            raise InputError(
                f"{path}: array '{name}' (n, {', '.join(map(str, shape))}) is missing or has another shape"
            )
        if not np.all(np.isfinite(data[name])):
            row = int(np.argwhere(~np.isfinite(data[name]))[0][0])
            raise InputError(f"{path}: '{name}' is not finite at position {row}")
    return data


def identify(data: dict[str, Array], *, supply_divider: float = 2.0) -> TumbleResult:
    """Fit all axes. Raises ``InputError`` when the attitudes do not span enough."""
    attitude, analog, field_V = data["attitude"], data["analog_V"], data["magnetometer_V"]
    up_body = attitude.transpose(0, 2, 1) @ np.array([0.0, 0.0, 1.0])  # specific force in g
    design = np.column_stack([np.ones(len(up_body)), up_body])
    condition = float(np.linalg.cond(design))
    if len(design) < 6 or condition > 20:
        raise InputError(
            f"{len(design)} positions with condition number {condition:.0f} do not show all axes; "
            "point each axis up and down at least once"
        )
    ratio = analog[:, 6] * supply_divider / NOMINAL_SUPPLY_V
    bias, scale, axes, residual = [], [], [], {}
    for i, sensor in enumerate(SENSORS):
        volts = analog[:, i] / ratio
        solution, *_ = np.linalg.lstsq(design, volts, rcond=None)
        bias.append(float(solution[0]))
        scale.append(float(np.linalg.norm(solution[1:])))
        axes.append([float(v) for v in solution[1:] / scale[-1]])
        residual[sensor] = float(np.std(volts - design @ solution))
    magnetometer_bias, matrix, magnetometer_residual = _magnetometer(attitude, field_V)
    magnetometer_scale = np.linalg.norm(matrix, axis=1)
    residual["magnetometer"] = magnetometer_residual
    table = {
        "bias_V": bias,
        "scale_V_per_g": scale,
        "axes": axes,
        "reference_temperature_C": float(np.mean((analog[:, 7] - 0.5) / 0.010)),
        "magnetometer_bias_V": magnetometer_bias.tolist(),
        "magnetometer_scale_V_per_uT": magnetometer_scale.tolist(),
        "magnetometer_axes": (matrix / magnetometer_scale[:, None]).tolist(),
    }
    return TumbleResult(table, residual, condition, len(design))


def _magnetometer(attitude: Array, volts: Array) -> tuple[Array, Array, float]:
    """Bias (3,), sensitivity (3,3) V/uT and residual rms V, by alternating between M and the world field B."""
    n = len(attitude)
    matrix = NOMINAL_MAGNETOMETER_V_PER_UT * np.eye(3)
    bias = volts.mean(axis=0)
    field = np.zeros(3)
    for _ in range(200):
        # B, given M and bias: stack M C^T over all positions
        stack = (matrix @ attitude.transpose(0, 2, 1)).reshape(3 * n, 3)
        field, *_ = np.linalg.lstsq(stack, (volts - bias).ravel(), rcond=None)
        body = attitude.transpose(0, 2, 1) @ field
        design = np.column_stack([np.ones(n), body])
        solution, *_ = np.linalg.lstsq(design, volts, rcond=None)
        previous, bias, matrix = matrix, solution[0], solution[1:].T
        # the product M B is what shows: fix the gauge by the mean scale
        matrix = matrix * (NOMINAL_MAGNETOMETER_V_PER_UT / np.cbrt(abs(np.linalg.det(matrix))))
        if np.max(np.abs(matrix - previous)) < 1e-12:
            break
    stack = (matrix @ attitude.transpose(0, 2, 1)).reshape(3 * n, 3)
    field, *_ = np.linalg.lstsq(stack, (volts - bias).ravel(), rcond=None)
    residual = float(np.std(volts - bias - (attitude.transpose(0, 2, 1) @ field) @ matrix.T))
    return bias, matrix, residual
