"""Error variance of specific force, angular acceleration and rate, for any set of single axes (Ang 2004 sec. 2.4).

Linear propagation through the weighted least squares of the firmware, and the scaled unscented transform
(Ang 2004 (2.48)-(2.51)) through its numeric solver. The variances are the diagonal (erratum 18), not row sums.
"""

from __future__ import annotations

import numpy as np

from firmware_py.sensing.kinematics import kinematic_params, observation_matrix
from firmware_py.sensing.numeric_kinematics import solve_numeric
from hal.arrays import Array
from tools.research.placement.configurations import Placement


def motion_covariance(placement: Placement, noise: Array | float) -> Array:
    """(6, 6) covariance of (f, alpha) at the origin; ``noise`` rms per axis, (N,) or one for all, m/s^2.

    Raises ValueError when the placement does not determine six degrees of freedom.
    """
    sigma = np.broadcast_to(np.asarray(noise, dtype=np.float64), (len(placement.axes),))
    observe = observation_matrix(placement.positions, placement.axes) / sigma[:, None]
    if np.linalg.matrix_rank(observe) < 6:
        raise ValueError(f"{placement.name}: these axes do not determine six degrees of freedom")
    inverse = np.linalg.pinv(observe)
    return inverse @ inverse.T


def angular_noise(placement: Placement, noise: Array | float) -> Array:
    """(4,) rms of alpha_x, alpha_y, alpha_z and of the vector, rad/s^2 (Latt 2011 Table 1)."""
    variance = np.diag(motion_covariance(placement, noise))[3:]
    return np.sqrt(np.append(variance, variance.sum()))


def point_noise(placement: Placement, noise: Array | float, point_m: Array) -> Array:
    """(3,) rms of the acceleration of a body point, m/s^2: f + alpha x r (Latt 2011 (31))."""
    x, y, z = point_m
    carry = np.hstack([np.eye(3), np.array([[0.0, z, -y], [-z, 0.0, x], [y, -x, 0.0]])])
    return np.sqrt(np.diag(carry @ motion_covariance(placement, noise) @ carry.T))


def rate_covariance_linear(placement: Placement, noise: Array | float, dt_s: float) -> Array:
    """(3, 3) covariance of one increment of the rate, (rad/s)^2: dt^2 of alpha's."""
    return dt_s**2 * motion_covariance(placement, noise)[3:, 3:]


def unscented(covariance: Array, function, kappa: float = 0.0) -> tuple[Array, Array]:  # pyright: ignore[reportMissingParameterType]
    """Mean and covariance of ``function(x)`` for x of zero mean and ``covariance`` (n, n) (Ang 2004 (2.48)-(2.50))."""
    n = len(covariance)
    root = np.linalg.cholesky((n + kappa) * covariance)
    points = np.vstack([np.zeros(n), root.T, -root.T])
    weights = np.full(2 * n + 1, 0.5 / (n + kappa))
    weights[0] = kappa / (n + kappa)
    values = np.array([function(point) for point in points])
    mean = weights @ values
    return mean, (weights[:, None] * (values - mean)).T @ (values - mean)


def rate_covariance_unscented(
    placement: Placement, noise: Array | float, dt_s: float, rate: Array | None = None
) -> Array:
    """(3, 3) covariance of the solved rate about ``rate`` (3,) rad/s, by the unscented transform."""
    n = len(placement.axes)
    sigma = np.broadcast_to(np.asarray(noise, dtype=np.float64), (n,))
    params = kinematic_params(placement.positions, placement.axes, np.array(sigma))
    before = np.zeros(3) if rate is None else np.asarray(rate, dtype=np.float64)
    along = placement.positions @ before
    centripetal = before * along[:, None] - placement.positions * (before @ before)
    readings = np.sum(placement.axes * centripetal, axis=1)
    out = np.empty(6)

    def solve(error: Array) -> Array:
        if solve_numeric(readings + error, before, dt_s, params[0], out) < 0:
            raise ValueError(f"{placement.name}: the rate did not converge")
        return before + dt_s * out[3:]

    return unscented(np.diag(sigma**2), solve)[1]


def band_rate_noise(
    placement: Placement, noise: Array | float, cutoff_rad_s: float, band_hz: tuple[float, float] = (8.0, 12.0)
) -> Array:
    """(3,) rms of the rate in a band, rad/s: white noise behind an RC whose total is ``noise``, integrated once.

    The one-sided density behind the RC is 4 noise^2 / cutoff (per rad/s: 2 / pi of it) times its squared gain.
    """
    variance = np.diag(motion_covariance(placement, noise))[3:]
    f = np.linspace(*band_hz, 401)
    w = 2.0 * np.pi * f
    density = 4.0 / cutoff_rad_s / (1.0 + (w / cutoff_rad_s) ** 2)  # of unit variance, per Hz
    return np.sqrt(variance * np.trapezoid(density / w**2, f))
