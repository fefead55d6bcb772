"""Lets the sensing stage run without one of its axes, by changing numbers in its existing arrays."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from firmware_py.records import Record
from firmware_py.sensing.config import SensingConfig
from firmware_py.sensing.kinematics import kinematic_params
from firmware_py.sensing.redundant_rate import parity_rows
from hal.types import STANDARD_GRAVITY

NOTHING_V = 1e12
"""Volts per m/s^2 of an axis that is to read nothing."""
PARALLEL = 0.9


def leave_out(axis: int, usual: NDArray[np.float64], params: Record, config: SensingConfig) -> float:
    """Solve without ``axis`` from now on; ``usual`` (M,) is the parity that calibration leaves.

    What is usual is taken out of the readings first, so that nothing jumps: it lies where the solution with all axes
    does not look. Other axes' cross terms take a parallel axis instead. Returns the noise of the tip's acceleration,
    as a multiple of what it was. Raises ValueError when the rest does not determine the motion.
    """
    places, axes, n = config.axis_positions(), np.array(config.axes), len(config.channels)
    noise = 1e-6 * STANDARD_GRAVITY * np.array(config.noise_ug_per_rtHz) * (0.25 * config.cutoff_rad_s) ** 0.5
    keep = [i for i in range(n) if i != axis]
    rest = kinematic_params(places[keep], axes[keep], noise[keep])
    stage = np.atleast_1d(params)[0]
    calibration, kinematics, null = stage["calibration"], stage["kinematics"], stage["null"]
    before = tip_noise(kinematics["solve"], noise, np.array(config.tip_m))
    calibration["bias_V"] += noise**2 * (null.T @ usual) * calibration["scale_V"]
    twin = _parallel(axis, axes)
    for key in ("in_plane", "out_of_plane"):
        others = calibration[key] == axis
        calibration[key][others] = twin if twin is not None else np.flatnonzero(others)
        if twin is None:
            for terms in ("bias_in_plane", "bias_out_of_plane", "scale_out_of_plane"):
                calibration[terms][others] = 0.0
    calibration["scale_V"][axis] = NOTHING_V
    kinematics["solve"][:] = 0.0
    kinematics["solve"][:, keep] = rest["solve"][0]
    kinematics["weight"][axis] = 0.0
    null[:] = 0.0
    if n > 7:
        null[: n - 7, keep] = parity_rows(places[keep], axes[keep], noise[keep])
    stage["parities"] = n - 7
    return tip_noise(kinematics["solve"], noise, np.array(config.tip_m)) / before


def tip_noise(solve: NDArray[np.float64], noise: NDArray[np.float64], tip_m: NDArray[np.float64]) -> float:
    """Return the square root of the summed variances of f + alpha x tip, m/s^2."""
    x, y, z = tip_m
    cross = np.array([[0.0, z, -y], [-z, 0.0, x], [y, -x, 0.0]])  # alpha x r = cross @ alpha
    return float(np.linalg.norm((solve[:3] + cross @ solve[3:]) * noise))


def _parallel(axis: int, axes: NDArray[np.float64]) -> int | None:
    along = axes @ axes[axis]
    along[axis] = 0.0
    best = int(along.argmax())
    return best if along[best] > PARALLEL else None
