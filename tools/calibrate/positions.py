"""Finds the positions of the accelerometers from the instrument swung about its tip in a dimple.

The tip does not move, so axis i reads s_i.(C^T g + alpha x rho_i + omega x (omega x rho_i)), rho_i its place from the
tip: the attitude C(t) is the only unknown motion, and six readings and the magnetic field know it more than twice over.
C(t) is a spline; it is fitted together with the places and, held by what a calibration leaves open, small errors of
bias, scale and direction of each axis and of its RC filter. Gravity goes with the angle, the levers with its second
derivative: swings of several frequencies tell the two apart.

Intervals: from 2 s blocks of the residuals (their errors are not white), or the fit's own if that is wider, and what a
curvature of the axes that no calibration has found would do.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import CubicSpline
from scipy.signal import butter, sosfiltfilt
from scipy.stats import t as student

from firmware_py.sensing.config import SensingConfig
from firmware_py.sensing.triad import triad
from hal.arrays import AnyArray, Array
from hal.types import STANDARD_GRAVITY
from tools.calibrate.multi_position import Estimate
from tools.calibrate.pivot_spline import Basis, Step, gauss_newton, uniform_basis
from tools.errors import InputError
from tools.numbers import rms, vector_rms

FIT_HZ = 50.0
KNOT_S = 0.05
LOWPASS_HZ, SLOPE_HZ = 10.0, 4.0
BLOCK_S = 2.0
SHORTEST_S = 10.0
FIELD_ERROR, LEAST_FIELD_ERROR = 0.01, 3e-4
"""Noise of the field, as a fraction of its size: the initial value, and the least for a magnetometer in a room."""
EXPECTED = {"bias": 0.02, "sensitivity": 2e-3, "filter": 5e-4, "field delay": 0.01}
"""Standard deviations (m/s^2, 1, s, s) of a calibrated axis and its filter."""
CURVATURE = 5e-4
"""Curvature (g per g^2) of calibrated axes, about the residual that ``micron calibrate sensors`` prints."""
LARGEST_RESIDUAL = 0.1
WIDEST_M = 0.002
ITERATIONS = 12


@dataclass(frozen=True)
class PositionFit:
    """``places`` (P, 3) m with intervals ``reach`` (P, 3); residual of the readings, m/s^2; moved from the drawing."""

    places: Array
    reach: Array
    believed: Array
    residual_m_s2: float
    condition: float
    seconds: float
    turning_rad_s: float
    names: tuple[str, ...]

    @property
    def parameters(self) -> dict[str, Estimate]:
        """Return the coordinates ``1_x`` ... in m."""
        return {
            f"{name}_{axis}": Estimate.around(v, r)
            for name, place, reach in zip(self.names, self.places, self.reach, strict=True)
            for axis, v, r in zip("xyz", place, reach, strict=True)
        }


@dataclass(frozen=True)
class _Problem:
    """Everything that stays the same while the fit goes on."""

    frame: Array
    readings: Array
    slope: Array
    field: Array
    field_slope: Array
    field_bend: Array
    axes: Array
    place_of: NDArray[np.intp]
    tip: Array
    gravity: float

    def split(self, x: AnyArray) -> dict[str, AnyArray]:
        """Globals by name: places (P, 3), bias (N,), sensitivity (N, 3), filter (N,), earth (2,), delay (1,)."""
        n, p = len(self.axes), int(self.place_of.max()) + 1
        sizes = {"places": 3 * p, "bias": n, "sensitivity": 3 * n, "filter": n, "earth": 2, "field delay": 1}
        out, at = {}, 0
        for name, size in sizes.items():
            out[name] = x[at : at + size]
            at += size
        return out

    def motion(self, curves: AnyArray) -> tuple[AnyArray, AnyArray, AnyArray, AnyArray]:
        """Return the body vectors of up and north-west (n, 3) each and the rates from angle curves (3, n, 3); may be
        complex.

        C = frame Rz(c2) Ry(c1) Rx(c0), as Euler angles are written in the errata.
        """
        (a, b, c), (da, db, dc), (dda, ddb, ddc) = (curves[d].T for d in range(3))
        sa, ca, sb, cb, sc, cc = np.sin(a), np.cos(a), np.sin(b), np.cos(b), np.sin(c), np.cos(c)
        turn = np.array(
            [
                [cc * cb, cc * sb * sa - sc * ca, cc * sb * ca + sc * sa],
                [sc * cb, sc * sb * sa + cc * ca, sc * sb * ca - cc * sa],
                [-sb, cb * sa, cb * ca],
            ]
        )
        world = np.einsum("ij,jkn->nik", self.frame, turn)
        omega = np.stack([da - sb * dc, ca * db + sa * cb * dc, -sa * db + ca * cb * dc], axis=1)
        alpha = np.stack(
            [
                dda - sb * ddc - cb * db * dc,
                ca * ddb - sa * da * db + sa * cb * ddc + (ca * cb * da - sa * sb * db) * dc,
                -sa * ddb - ca * da * db + ca * cb * ddc + (-sa * cb * da - ca * sb * db) * dc,
            ],
            axis=1,
        )
        return world[:, 2], world[:, 0], omega, alpha

    def force(self, curves: AnyArray, places: AnyArray) -> AnyArray:
        """Return the specific force (n, N, 3) in m/s^2 at each axis."""
        up, _, omega, alpha = self.motion(curves)
        rho = (places.reshape(-1, 3) - self.tip)[self.place_of]
        along = omega @ rho.T
        square = np.sum(omega * omega, axis=1)
        return (
            self.gravity * up[:, None, :]
            + np.cross(alpha[:, None, :], rho[None])
            + omega[:, None, :] * along[:, :, None]
            - square[:, None, None] * rho[None]
        )

    def predict(self, curves: AnyArray, x: AnyArray) -> AnyArray:
        """Return readings and field (n, N + 3)."""
        g = self.split(x)
        axes = self.axes + g["sensitivity"].reshape(-1, 3)
        readings = np.einsum("nik,ik->ni", self.force(curves, g["places"]), axes) + g["bias"]
        readings = readings + g["filter"] * self.slope
        up, north, _, _ = self.motion(curves)
        late = g["field delay"]
        field = g["earth"][0] * north + g["earth"][1] * up - late * self.field_slope
        # a measured slope is that of the delayed field: half the square comes with the other sign
        field = field - 0.5 * late * late * self.field_bend
        return np.concatenate([readings, field], axis=1)

    def slopes(self, curves: Array, x: Array) -> tuple[Array, Array]:
        """Return the slopes by curve (n, N + 3, 3, 3) and by globals (n, N + 3, G), by complex steps, exact to
        rounding."""
        h = 1e-20
        n, rows = len(self.readings), len(self.axes) + 3
        by_curve, by_global = np.empty((n, rows, 3, 3)), np.empty((n, rows, len(x)))
        for d in range(3):
            for a in range(3):
                moved = curves.astype(np.complex128)
                moved[d, :, a] += 1j * h
                by_curve[:, :, d, a] = np.imag(self.predict(moved, x)) / h
        for k in range(len(x)):
            moved = x.astype(np.complex128)
            moved[k] += 1j * h
            by_global[:, :, k] = np.imag(self.predict(curves.astype(np.complex128), moved)) / h
        return by_curve, by_global


@dataclass(frozen=True)
class _Solved:
    """Holds the end of the iteration: curves' ``coefficients``, globals ``x``, ``noise`` (N + 3,) per column, residuals
    (n, N + 3), and the last step."""

    coefficients: Array
    x: Array
    noise: Array
    residual: Array
    step: Step


def fit_positions(readings: Array, field: Array, rate_hz: float, config: SensingConfig) -> PositionFit:
    """Fit the places from readings (n, N) m/s^2 and field (n, 3) uT of a swing. ``InputError`` says what is wrong with
    the recording."""
    seconds = len(readings) / rate_hz
    if seconds < SHORTEST_S or rate_hz < 2.0 * FIT_HZ:
        raise InputError(f"{seconds:.1f} s at {rate_hz:g} Hz: swing for a minute, sampled at {2 * FIT_HZ:g} Hz or more")
    problem, t = _prepare(readings, field, rate_hz, config)
    basis = uniform_basis(t, KNOT_S)
    believed = np.array(config.positions_m)
    k = believed.size
    solved = _solve(problem, basis, basis.fit(_first_angles(problem, config)), believed)
    step, n = solved.step, len(problem.axes)
    curves = basis.curves(solved.coefficients)
    omega = problem.motion(curves)[2]
    variance = _variance(step, solved.residual / solved.noise[None, :], round(BLOCK_S * FIT_HZ))
    force = problem.force(curves, problem.split(solved.x)["places"])
    variance += _bent(step, force / problem.gravity, solved.noise)
    blocks = int(seconds / BLOCK_S)
    reach = float(student.ppf(0.975, max(2, blocks - 1))) * np.sqrt(variance[:k])
    size = np.sqrt(np.diag(step.information))
    fit = PositionFit(
        solved.x[:k].reshape(-1, 3),
        reach.reshape(-1, 3),
        believed,
        rms(solved.residual[:, :n]),
        float(np.linalg.cond(step.information / np.outer(size, size)) ** 0.5),
        seconds,
        vector_rms(omega),
        tuple(str(i + 1) for i in range(len(believed))),
    )
    _refuse(fit)
    return fit


def _start(problem: _Problem, basis: Basis, coefficients: Array, believed: Array) -> tuple[Array, Array]:
    """Return the globals to begin with, and the inverse variances of their priors; 0 means that there is none."""
    x = np.zeros(believed.size + 5 * len(problem.axes) + 3)
    x[: believed.size] = believed.ravel()
    prior = np.zeros(len(x))
    for name, part in problem.split(np.arange(len(x), dtype=np.float64)).items():
        if name in EXPECTED:
            prior[part.astype(np.intp)] = EXPECTED[name] ** -2
    up, north, _, _ = problem.motion(basis.curves(coefficients))
    x[_earth(x)] = [np.mean(np.sum(problem.field * north, axis=1)), np.mean(np.sum(problem.field * up, axis=1))]
    return x, prior


def _earth(x: Array) -> slice:
    return slice(len(x) - 3, len(x) - 1)


def _solve(problem: _Problem, basis: Basis, coefficients: Array, believed: Array) -> _Solved:
    """Run Gauss-Newton on curves and globals from the drawing's places until these stand still."""
    n, k = len(problem.axes), believed.size
    x, prior = _start(problem, basis, coefficients, believed)
    field_size = float(np.linalg.norm(x[_earth(x)]))
    noise = np.full(n + 3, 0.02)
    noise[n:] = FIELD_ERROR * field_size
    measured = np.hstack([problem.readings, problem.field])
    expected = np.where(prior > 0.0, 0.0, x)
    step: Step | None = None
    for iteration in range(ITERATIONS):
        curves = basis.curves(coefficients)
        by_curve, by_global = problem.slopes(curves, x)
        residual = measured - problem.predict(curves, x)
        if iteration == 3:  # from here on the readings weigh what they are seen to deserve
            noise[:n] = max(rms(residual[:, :n]), 1e-4)
            noise[n:] = max(rms(residual[:, n:]), LEAST_FIELD_ERROR * field_size)
        scale = noise[None, :]
        step = gauss_newton(
            basis,
            residual / scale,
            by_curve / scale[:, :, None, None],
            by_global / scale[:, :, None],
            prior,
            np.where(prior > 0.0, x - expected, 0.0),
        )
        coefficients, x = coefficients + step.coefficients, x + step.globals_
        if iteration > 3 and np.max(np.abs(step.globals_[:k])) < 1e-8:
            break
    assert step is not None
    return _Solved(coefficients, x, noise, measured - problem.predict(basis.curves(coefficients), x), step)


def _refuse(fit: PositionFit) -> None:
    if not np.all(np.isfinite(fit.places)) or fit.residual_m_s2 > LARGEST_RESIDUAL:
        raise InputError(
            f"residual {fit.residual_m_s2:.3g} m/s^2 ({LARGEST_RESIDUAL:g} is allowed): the tip did not stay in its "
            "place, an axis saturated, or bias and scale are not calibrated"
        )
    if np.max(fit.reach) > WIDEST_M:
        raise InputError(
            f"places are known to {1e3 * np.max(fit.reach):.1f} mm only ({1e3 * WIDEST_M:g} mm is allowed; the body "
            f"turned at {fit.turning_rad_s:.2f} rad/s rms): swing wider and faster, about all axes, at 1 to 2 Hz"
        )


def _prepare(readings: Array, field: Array, rate_hz: float, config: SensingConfig) -> tuple[_Problem, Array]:
    """Low-passed without phase, freed of the nominal RC filter, every 20 ms, half a second of each end left out."""
    low = butter(4, LOWPASS_HZ, fs=rate_hz, output="sos")
    smooth, magnet = (np.asarray(sosfiltfilt(low, a, axis=0)) for a in (readings, _not_held(field)))
    every = np.arange(len(readings)) / rate_hz
    slope = CubicSpline(every, smooth, axis=0)(every, 1)
    magnet_slope, magnet_bend = (CubicSpline(every, magnet, axis=0)(every, d) for d in (1, 2))
    edge = 0.5
    t = np.arange(edge, len(readings) / rate_hz - edge, 1.0 / FIT_HZ)
    rows = np.round(t * rate_hz).astype(np.intp)
    places = len(config.positions_m)
    axes = np.array(config.axes)
    place_of = np.repeat(np.arange(places), len(axes) // places)
    undone = smooth + slope / config.cutoff_rad_s
    # slopes are regressors of the filters' errors and must not share the noise of the readings
    quiet = butter(4, SLOPE_HZ, fs=rate_hz, output="sos")
    slope, magnet_slope, magnet_bend = (
        np.asarray(sosfiltfilt(quiet, a, axis=0)) for a in (slope, magnet_slope, magnet_bend)
    )
    problem = _Problem(
        np.eye(3), undone[rows], slope[rows], magnet[rows], magnet_slope[rows], magnet_bend[rows], axes, place_of,
        np.array(config.tip_m), config.gravity_m_s2,
    )  # fmt: skip
    return problem, rows / rate_hz


def _not_held(field: Array) -> Array:
    """A slower converter's values are held until the next: a curve through the moments at which they change."""
    fresh = np.flatnonzero(np.any(np.diff(field, axis=0) != 0.0, axis=1)) + 1
    if len(fresh) > 0.5 * len(field) or len(fresh) < 8:
        return field
    rows = np.clip(np.arange(len(field)), fresh[0], fresh[-1])
    return np.asarray(CubicSpline(fresh, field[fresh], axis=0)(rows))


def _first_angles(problem: _Problem, config: SensingConfig) -> Array:
    """Return angles (n, 3) in rad from gravity and field of each instant, and set the frame to the attitude in the
    middle."""
    solve = np.linalg.pinv(np.array(config.observation()))
    motion = problem.readings @ solve.T
    force = motion[:, :3] + np.cross(motion[:, 3:], problem.tip)
    seen = np.empty((len(force), 3, 3))
    for i in range(len(force)):
        if not triad(force[i], problem.field[i], seen[i]):
            raise InputError("no usable magnetic field in the recording: the heading of the swing is not known")
    u, _, v = np.linalg.svd(seen.mean(axis=0))
    problem.frame[:] = u @ np.diag([1.0, 1.0, np.linalg.det(u @ v)]) @ v
    turn = problem.frame.T @ seen
    b = -np.arcsin(np.clip(turn[:, 2, 0], -1.0, 1.0))
    return np.stack([np.arctan2(turn[:, 2, 1], turn[:, 2, 2]), b, np.arctan2(turn[:, 1, 0], turn[:, 0, 0])], axis=1)


def _variance(step: Step, residual: Array, block: int) -> Array:
    """(G,) the wider of the fit's own variance and that from blocks of residuals."""
    inverse = np.linalg.inv(step.information)
    starts = np.arange(0, len(residual), block)
    pulls = np.add.reduceat(np.einsum("nrg,nr->ng", step.projected, residual), starts, axis=0)
    scatter = inverse @ (pulls.T @ pulls) @ inverse
    return np.maximum(np.diag(inverse), np.diag(scatter))


def _bent(step: Step, force_g: Array, noise: Array) -> Array:
    """Return the variance (G,) from readings that bend by ``CURVATURE`` with any product of two components of the
    force."""
    inverse = np.linalg.inv(step.information)
    variance = np.zeros(len(inverse))
    for i in range(force_g.shape[1]):
        for a in range(3):
            for b in range(a + 1):
                bend = CURVATURE * STANDARD_GRAVITY * force_g[:, i, a] * force_g[:, i, b]
                variance += (inverse @ (step.projected[:, i].T @ bend / noise[i])) ** 2
    return variance
