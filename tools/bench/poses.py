"""The instrument's six accelerometers from resting poses turned by hand: no stage, only the size of gravity is known.

Sensors 1x, 2y, 1z and 3x, 3y, 2z are one triad each; at rest both feel the same gravity wherever they sit. Each triad
is fitted as in ``tools.calibrate.multi_position``. Bias and scale go into the calibration file; directions of the axes
stay as they are, since a triad's own axes are known only up to a turn.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from tools.calibrate.multi_position import fit_poses
from tools.errors import InputError

AXES = ("1x", "1z", "2y", "2z", "3x", "3y")
TRIADS = ((0, 2, 1), (4, 5, 3))
"""Columns x, y, z of each triad in the firmware's sensor order."""
MIN_POSES = 12
INPUTS = 8
"""Voltages of a frame."""


def at_nominal_supply(rows: NDArray[np.float64], sensing: Mapping[str, Any]) -> NDArray[np.float64]:
    """Return volts (n, 6) of the axes from ``rows`` (n, 9): eight inputs and the supply, V, each the mean of a pose.

    The sensors are ratiometric, and the calibration file speaks of the nominal supply. ``sensing``: the firmware's
    sensing stage, for the inputs of the axes. ``InputError`` for rows or benches that do not fit.
    """
    channels = list(sensing.get("channels", range(6)))
    if rows.ndim != 2 or rows.shape[1] != INPUTS + 1:
        raise InputError(f"a pose is {INPUTS} voltages and the supply's; these are {rows.shape}")
    if len(channels) != len(AXES):
        raise InputError(f"poses by hand are for the axes {', '.join(AXES)}; this bench has {len(channels)} axes")
    supply = rows[:, INPUTS]
    if not (np.isfinite(supply) & (supply > 0.0)).all():
        raise InputError("the supply of a pose is not a positive voltage")
    return rows[:, channels] * (float(sensing.get("nominal_supply_V", 5.0)) / supply[:, None])


def identify(means_V: NDArray[np.float64], gravity_m_s2: float) -> dict[str, Any]:
    """Identify the axes from ``means_V`` (n, 6), one row per pose. Raises ``InputError`` for too few or too similar
    poses."""
    if means_V.ndim != 2 or means_V.shape[1] != len(AXES) or len(means_V) < MIN_POSES:
        raise InputError(f"at least {MIN_POSES} poses of 6 voltages are needed, these are {means_V.shape}")
    if not np.isfinite(means_V).all():
        raise InputError("a voltage of a pose is not a number")
    bias, scale = np.zeros(6), np.zeros(6)
    residual: list[float] = []
    for triad in TRIADS:
        fit = fit_poses(means_V[:, triad], np.ones(len(means_V)), gravity_m_s2)
        for axis, column in zip("xyz", triad, strict=True):
            bias[column] = fit.parameters[f"bias_{axis}"].value
            scale[column] = gravity_m_s2 / fit.parameters[f"scale_{axis}"].value
        residual.append(fit.residual_m_s2)
    return {
        "table": {"bias_V": bias.tolist(), "scale_V_per_g": scale.tolist()},
        "poses": len(means_V),
        "residual_m_s2": residual,
    }
