"""Identifies the sensors of a resting instrument from a tumble on two rotary stages (Ang 2004 sec. 3.2.1.7, 3.2.2.4).

At rest every axis reads f = C_WB^T (0, 0, g) (erratum 2). Accelerometers: ``composite``, magnetometer: ``field_frame``.
C_WB = R_y(alpha) R_z(beta) with the stage angles of Ang 2004 Fig. 3.3: alpha = 0 lays the x-y plane level, at alpha =
90 degrees beta = 0 points x along gravity.
"""

from __future__ import annotations

from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np

from firmware_py.sensing.config import SensingConfig
from hal.arrays import Array
from tools.calibrate.composite import CompositeFit, fit_composite
from tools.calibrate.field_frame import FieldFrame, fit_field
from tools.calibrate.stage_log import load_stage_log
from tools.errors import InputError

NOMINAL_SUPPLY_V = 5.0
SENSORS = ("1x", "1z", "2y", "2z", "3x", "3y")
DRIFT_TOLERANCE_G = 2e-3


@dataclass(frozen=True)
class TumbleResult:
    """Holds the identified ``table`` for [sensing] of a calibration, and the fits with intervals and residuals."""

    table: dict[str, Any]
    accelerometers: CompositeFit
    magnetometer: FieldFrame
    drift_fitted: bool

    @property
    def positions(self) -> int:
        return self.accelerometers.poses

    @property
    def condition(self) -> float:
        """Return the largest condition number of the axes."""
        return max(axis.condition for axis in self.accelerometers.axes)

    def as_dict(self) -> dict[str, Any]:
        """Return the result as JSON values."""
        return {
            "table": self.table,
            "positions": self.positions,
            "condition": self.condition,
            "missing": self.accelerometers.missing,
            "drift_fitted": self.drift_fitted,
            "axes": {
                name: {**asdict(axis), "scale_V_per_g": axis.scale_V_per_g, "direction": axis.direction}
                for name, axis in zip(SENSORS, self.accelerometers.axes, strict=True)
            },
            "magnetometer": asdict(self.magnetometer),
        }


def load_tumble(folder: Path) -> dict[str, Array]:
    """``attitude`` (n,3,3) body to world, ``analog_V`` (n,8), ``magnetometer_V`` (n,3), and ``magnetometer_reset_V``
    if it was recorded; one row a pose (rows at one pair of stage angles are averaged)."""
    log = load_stage_log(folder)
    data = {"attitude": log.attitude}
    for name, width in (("analog_V", 8), ("magnetometer_V", 3), ("magnetometer_reset_V", 3)):
        if name == "magnetometer_reset_V" and f"{name}_0" not in log.columns:
            continue
        data[name] = log.matrix(tuple(f"{name}_{i}" for i in range(width)))
    return data


def identify(
    data: dict[str, Array], *, supply_divider: float = 2.0, quadratic: bool = True, fit_drift: bool = False
) -> TumbleResult:
    """Fit all axes. InputError when the attitudes do not span enough, or while the sensors still warm up.

    ``quadratic`` off leaves bias, scale and direction alone (Ang 2004 (3.1)-(3.3), (3.15)-(3.19)).
    """
    attitude, analog = data["attitude"], data["analog_V"]
    up_body = attitude.transpose(0, 2, 1) @ np.array([0.0, 0.0, 1.0])  # specific force in g
    ratio = analog[:, 6] * supply_divider / NOMINAL_SUPPLY_V
    nominal = SensingConfig()
    fit = fit_composite(
        analog[:, :6] / ratio[:, None],
        up_body,
        nominal.in_plane,
        nominal.out_of_plane,
        quadratic=quadratic,
        fit_drift=fit_drift,
    )
    if not fit_drift:
        refuse_drift(fit)
    field = fit_field(attitude, data["magnetometer_V"], data.get("magnetometer_reset_V"))
    scale = np.linalg.norm(field.matrix, axis=1)
    table: dict[str, Any] = {
        "bias_V": [axis.value("bias_V") for axis in fit.axes],
        "scale_V_per_g": [axis.scale_V_per_g for axis in fit.axes],
        "axes": [list(axis.direction) for axis in fit.axes],
    }
    if quadratic:
        table |= {
            "in_plane": list(nominal.in_plane),
            "out_of_plane": list(nominal.out_of_plane),
            "bias_in_plane": [[0.0, axis.value("in_plane_2")] for axis in fit.axes],
            "bias_out_of_plane": [[0.0, axis.value("out_of_plane_2")] for axis in fit.axes],
            "scale_out_of_plane": [[axis.value("scale_1"), axis.value("scale_2")] for axis in fit.axes],
        }
    table |= {
        "reference_temperature_C": float(np.mean((analog[:, 7] - 0.5) / 0.010)),
        "magnetometer_bias_V": [e.value for e in field.bias],
        "magnetometer_scale_V_per_uT": scale.tolist(),
        "magnetometer_axes": (field.matrix / scale[:, None]).tolist(),
    }
    return TumbleResult(table, fit, field, fit_drift)


def refuse_drift(fit: CompositeFit) -> None:
    """Raise ``InputError`` if an axis' bias moved significantly during the recording by more than 2 mg."""
    for i, axis in enumerate(fit.axes):
        moved = axis.drift.value / axis.scale_V_per_g
        sure = min(abs(axis.drift.low), abs(axis.drift.high)) if axis.drift.low * axis.drift.high > 0.0 else 0.0
        if abs(moved) > DRIFT_TOLERANCE_G and np.isfinite(sure) and sure > 0.0:
            raise InputError(
                f"the bias of axis {SENSORS[i] if len(fit.axes) == 6 else i} moved by {1e3 * moved:.1f} mg during the "
                f"recording ({1e3 * DRIFT_TOLERANCE_G:g} mg is allowed): the sensors still warm up; wait and record "
                "again, or give --drift fit"
            )
