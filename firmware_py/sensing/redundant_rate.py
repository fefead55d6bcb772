"""Estimates a tumbling body's rate from more than six accelerometer axes, held by their own centripetal part.

With six axes the rate is an integral of alpha, and alpha needs the rate for its centripetal part: an error grows as
exp(k |omega| t), k about the ratio of the largest to the smallest lever. A hand (below 1 rad/s) hardly shows it, at 3
rad/s it is a thousandfold within a second, with ``solve_numeric`` as well: each of its steps takes the rate before for
exact. More than six axes leave combinations that neither f nor alpha enters, only products of rates (Ang 2004 (2.3)); a
Kalman filter of the rate uses those. The products are the same for omega and -omega: the sign is that of the start.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from firmware_py.records import Record, new_record
from firmware_py.sensing.kinematics import kinematic_params, kinematics_dtype, observation_matrix, solve_motion
from hal.compiled import kernel


def redundant_dtype(n: int) -> np.dtype[Any]:
    """``null`` (n - 6, n): combinations of readings free of f and alpha, of unit noise; ``alpha_noise`` (3, 3)."""
    return np.dtype([("kinematics", kinematics_dtype(n)), ("null", "f8", (n - 6, n)), ("alpha_noise", "f8", (3, 3))])


REDUNDANT_STATE = np.dtype([("rate", "f8", (3,)), ("covariance", "f8", (3, 3)), ("motion", "f8", (6,))])


def parity_rows(
    positions: NDArray[np.float64], axes: NDArray[np.float64], noise: NDArray[np.float64]
) -> NDArray[np.float64]:
    """(N - 6, N) combinations of readings free of f and alpha, of unit noise; ``noise`` (N,) rms per sample, m/s^2."""
    whitened = observation_matrix(positions, axes) / noise[:, None]
    left, _, _ = np.linalg.svd(whitened)
    return left[:, 6:].T / noise


def redundant_params(positions: NDArray[np.float64], axes: NDArray[np.float64], noise: NDArray[np.float64]) -> Record:
    """N > 6 axes: positions (N, 3) m, unit axes (N, 3), noise (N,) rms per sample, m/s^2. ValueError otherwise."""
    if len(axes) <= 6:
        raise ValueError(f"{len(axes)} axes leave nothing over after f and alpha; more than six are needed")
    kinematics = kinematic_params(positions, axes, noise)
    solve = kinematics["solve"][0][3:]
    return new_record(
        redundant_dtype(len(axes)),
        kinematics=kinematics,
        null=parity_rows(positions, axes, noise),
        alpha_noise=(solve * noise**2) @ solve.T,
    )


def redundant_state(rate: NDArray[np.float64], uncertainty_rad_s: float) -> Record:
    """Start at ``rate`` (3,) rad/s, known to ``uncertainty_rad_s``."""
    return new_record(REDUNDANT_STATE, rate=rate, covariance=uncertainty_rad_s**2 * np.eye(3))


@kernel
def redundant_rate_step(readings: NDArray[np.float64], dt_s: float, state: Record, params: Record) -> None:
    """One sample: ``readings`` (N,) m/s^2; updates rate rad/s, its covariance and ``motion`` = (f, alpha)."""
    s, p = state[0], params[0]
    kin = p.kinematics
    n = len(readings)
    solve_motion(readings, s.rate, kin, s.motion)
    slope = np.empty((n, 3))
    centripetal_slope(s.rate, kin, slope)
    alpha_slope = kin.solve[3:].copy() @ slope
    step = np.eye(3) - dt_s * alpha_slope
    for i in range(3):
        s.rate[i] += dt_s * s.motion[3 + i]
    covariance = step @ s.covariance.copy() @ step.T + dt_s * dt_s * p.alpha_noise.copy()
    h, left = np.empty((n - 6, 3)), np.empty(n - 6)
    parity(readings, s.rate, kin, p.null, slope, left, h)
    innovation = h @ covariance @ h.T + np.eye(n - 6)
    gain = np.linalg.solve(innovation, h @ covariance).T.copy()
    change = gain @ left
    for i in range(3):
        s.rate[i] += change[i]
    keep = np.eye(3) - gain @ h
    s.covariance[:, :] = keep @ covariance @ keep.T + gain @ gain.T
    solve_motion(readings, s.rate, kin, s.motion)


@kernel
def parity(
    readings: NDArray[np.float64],
    rate: NDArray[np.float64],
    kinematics: Record,
    null: NDArray[np.float64],
    slope: NDArray[np.float64],
    out: NDArray[np.float64],
    by_rate: NDArray[np.float64],
) -> None:
    """``out`` (M,): what ``null`` (M, N) leaves of readings (N,) without their centripetal part; ``by_rate`` (M, 3) its
    slope with the rate, sign turned. ``slope`` (N, 3) is work space."""
    centripetal_slope(rate, kinematics, slope)
    for m in range(len(out)):
        out[m] = 0.0
        by_rate[m, 0] = by_rate[m, 1] = by_rate[m, 2] = 0.0
        for i in range(len(readings)):
            # c(omega) is of second degree without lower terms: slope omega = 2 c
            c = 0.5 * (slope[i, 0] * rate[0] + slope[i, 1] * rate[1] + slope[i, 2] * rate[2])
            out[m] += null[m, i] * (readings[i] - c)
            for k in range(3):
                by_rate[m, k] += null[m, i] * slope[i, k]


@kernel
def centripetal_slope(rate: NDArray[np.float64], kinematics: Record, out: NDArray[np.float64]) -> None:
    """``out`` (N, 3): derivative of s.(omega x (omega x r)) of each axis with the rate."""
    for i in range(len(out)):
        r, a = kinematics.positions[i], kinematics.axes[i]
        along = rate[0] * r[0] + rate[1] * r[1] + rate[2] * r[2]
        across = rate[0] * a[0] + rate[1] * a[1] + rate[2] * a[2]
        radial = a[0] * r[0] + a[1] * r[1] + a[2] * r[2]
        for k in range(3):
            out[i, k] = a[k] * along + across * r[k] - 2.0 * radial * rate[k]
