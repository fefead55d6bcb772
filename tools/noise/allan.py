"""Overlapping Allan deviation and what it says of a sensor (IEEE 952-1997 annex C, IEEE 1293; Ang 2004 sec. 3.3).

The variance is sigma^2(tau) = N^2 / tau + (2 ln 2 / pi) B^2 + K^2 tau / 3 + R^2 tau^2 / 2 (erratum 34): white noise N
at tau = 1, flicker B = flat / 0.664, random walk K at tau = 3, ramp R at sqrt 2.
"""

from __future__ import annotations

from dataclasses import dataclass
from math import log, pi

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import nnls
from scipy.stats import chi2

from hal.arrays import Array
from hal.compiled import kernel

TERMS = ("white", "flicker", "walk", "ramp")
FLAT = 2.0 * log(2.0) / pi
EXCESS = (0.0, 0.01, 0.02, 0.05, 0.1, 0.2, 0.5)
"""Relative errors of the variance that are granted to the four terms themselves: no real sensor is made of them."""
EXCESS_AT_START = 0.02
"""A start of the fit that needs more than this is too early: a filter or the converter's steps bend the curve there."""
MISFIT = 2.0
"""Chi-square for each degree of freedom up to which a fit counts as one."""
REPEATS = 100
SIMULATED = 8192
"""Samples of a simulated recording, at most twice that."""


@kernel
def overlapping_variance(phase, factors, dt_s, out):
    """``out[j]`` = overlapping Allan variance at ``factors[j]`` samples, from ``phase`` (n + 1,), the summed signal."""
    n = phase.shape[0]
    for j in range(factors.shape[0]):
        m = factors[j]
        total = 0.0
        for i in range(n - 2 * m):
            d = phase[i + 2 * m] - 2.0 * phase[i + m] + phase[i]
            total += d * d
        out[j] = total / (2.0 * (m * dt_s) ** 2 * (n - 2 * m))


@dataclass(frozen=True)
class AllanCurve:
    """Holds ``tau_s``, ``deviation`` in the signal's unit, its 95 % interval ``low`` .. ``high`` and degrees of
    freedom; ``samples`` every ``dt_s`` it was made from."""

    tau_s: Array
    deviation: Array
    low: Array
    high: Array
    freedom: Array
    samples: int
    dt_s: float


def octave_factors(samples: int, shortest_terms: int = 3) -> NDArray[np.int64]:
    """Return the factors (k,) 1, 2, 4, ... in samples, as long as ``shortest_terms`` differences are left."""
    factors = []
    m = 1
    while samples + 1 - 2 * m >= shortest_terms:
        factors.append(m)
        m *= 2
    return np.array(factors, dtype=np.int64)


def allan_curve(signal: Array, rate_hz: float, factors: NDArray[np.int64] | None = None) -> AllanCurve:
    """Return the overlapping Allan deviation of evenly sampled ``signal`` (n,), n >= 8, at octaves or ``factors``.

    Raises ValueError for a signal that is too short, not finite, or one-valued.
    """
    signal = np.ascontiguousarray(signal, dtype=np.float64)
    if signal.ndim != 1 or len(signal) < 8:
        raise ValueError(f"{signal.shape} samples: an Allan deviation needs a row of at least 8")
    if not np.all(np.isfinite(signal)):
        raise ValueError(f"sample {int(np.argmin(np.isfinite(signal)))} is not finite")
    if np.ptp(signal) == 0.0:
        raise ValueError("the signal never changes: a frozen sensor has no noise to identify")
    if factors is None:
        factors = octave_factors(len(signal))
    dt_s = 1.0 / rate_hz
    phase = np.concatenate([[0.0], np.cumsum(signal - signal.mean())]) * dt_s
    variance = np.empty(len(factors))
    overlapping_variance(phase, factors, dt_s, variance)
    freedom = degrees_of_freedom(len(phase), factors, variance)
    deviation = np.sqrt(variance)
    return AllanCurve(
        (factors * dt_s).astype(np.float64),
        deviation,
        deviation * np.sqrt(freedom / chi2.ppf(0.975, freedom)),
        deviation * np.sqrt(freedom / chi2.ppf(0.025, freedom)),
        freedom,
        len(signal),
        dt_s,
    )


def degrees_of_freedom(points: int, factors: NDArray[np.int64], variance: Array) -> Array:
    """Equivalent degrees of freedom of each overlapping estimate (NIST SP 1065, Table 5), by the local slope."""
    n, m = float(points), factors.astype(np.float64)
    slope = np.gradient(np.log(np.maximum(variance, 1e-300)), np.log(m)) if len(m) > 1 else np.array([-1.0])
    white = (3.0 * (n - 1.0) / (2.0 * m) - 2.0 * (n - 2.0) / n) * 4.0 * m**2 / (4.0 * m**2 + 5.0)
    flicker = np.where(m == 1, 2.0 * (n - 2.0) / (2.3 * n - 4.9), 5.0 * n**2 / (4.0 * m * (n + 3.0 * m)))
    flicker = np.where(m == 1, flicker * n / 2.0, flicker)  # the table's m = 1 entry is per pair
    walk = (n - 2.0) / m * ((n - 1.0) ** 2 - 3.0 * m * (n - 1.0) + 4.0 * m**2) / (n - 3.0) ** 2
    chosen = np.where(slope < -0.5, white, np.where(slope < 0.5, flicker, walk))
    return np.maximum(chosen, 1.0)


@dataclass(frozen=True)
class Coefficient:
    """Holds ``value`` with its 95 % interval. 0 with an upper limit means: not seen."""

    value: float
    low: float
    high: float


@dataclass(frozen=True)
class NoiseModel:
    """Holds N (unit sqrt s: the one-sided density over sqrt 2), B (unit), K (unit / sqrt s), R (unit / s).

    Fitted to averages of ``shortest_s`` and more, in which the four terms are wrong by ``excess`` of the variance.
    """

    white: Coefficient
    flicker: Coefficient
    walk: Coefficient
    ramp: Coefficient
    shortest_s: float
    excess: float

    def variance(self, tau_s: Array) -> Array:
        """Return the Allan variance (k,) of the model, in unit^2."""
        return _terms(tau_s) @ np.array([getattr(self, name).value ** 2 for name in TERMS])


def _terms(tau_s: Array) -> Array:
    return np.stack([1.0 / tau_s, np.full_like(tau_s, FLAT), tau_s / 3.0, tau_s**2 / 2.0], axis=1)


def identify(curve: AllanCurve, shortest_s: float | None = None) -> NoiseModel:
    """Fit N, B, K, R by non-negative least squares on the relative error of the variance.

    Averages shorter than ``shortest_s`` are left out; without it the fit starts where the four terms begin to explain
    the curve (a filter or quantisation in front of the converter bends it before). Short averages are so many that
    their own chance is nothing beside what the terms miss: that is found as ``excess`` and counts in weights and
    intervals.

    Intervals: the fit repeated on ``REPEATS`` simulated recordings of the model, as long as this one (neighbouring
    octaves share their data, so that intervals from each point's own chi-square would be too narrow).
    """
    keep = (curve.tau_s >= (shortest_s or 0.0)) & (curve.freedom >= 2.0)
    tau, variance, freedom = curve.tau_s[keep], curve.deviation[keep] ** 2, curve.freedom[keep]
    if len(tau) < 4:
        raise ValueError(f"{len(tau)} usable averaging times: four are needed to tell the noise terms apart")
    start, excess = _start(tau, variance, freedom, given=shortest_s is not None)
    tau, variance, freedom = tau[start:], variance[start:], freedom[start:]
    terms, weight = _terms(tau), _weight(freedom, excess)
    value = _fit(terms, variance, weight)
    fitted = np.maximum(terms @ value, 1e-300)
    rng = np.random.default_rng(0)

    def luck() -> Array:
        missed = np.exp(excess * rng.standard_normal(len(tau)))
        return missed * _luck(curve, value, tau, freedom, rng)

    drawn = np.sqrt([_fit(terms, fitted * luck(), weight) for _ in range(REPEATS)])
    best = np.sqrt(value)
    # around the estimate: best^2 / quantile for what was seen, so that a low draw means the truth may be higher
    low, high = np.quantile(drawn, 0.025, axis=0), np.quantile(drawn, 0.975, axis=0)
    lower = np.maximum(0.0, 2.0 * best - high)
    upper = np.where(best > 0.0, np.maximum(2.0 * best - low, high), high)
    coefficients = [Coefficient(float(best[i]), float(lower[i]), float(upper[i])) for i in range(4)]
    return NoiseModel(*coefficients, shortest_s=float(tau[0]), excess=excess)


def _start(tau: Array, variance: Array, freedom: Array, *, given: bool) -> tuple[int, float]:
    """First average and ``excess`` with which the terms explain the curve; the best there is if nothing does."""
    best, least = (0, EXCESS[-1]), np.inf
    last = 1 if given else max(1, len(tau) - 5)
    for start in range(last):
        for excess in EXCESS:
            if not given and excess > EXCESS_AT_START:
                break
            terms, weight = _terms(tau[start:]), _weight(freedom[start:], excess)
            seen = variance[start:]
            fitted = np.maximum(terms @ _fit(terms, seen, weight), 1e-300)
            misfit = float(np.mean((weight * (seen / fitted - 1.0)) ** 2))
            if misfit <= MISFIT:
                return start, excess
            if misfit < least:
                best, least = (start, excess), misfit
    return best


def _weight(freedom: Array, excess: float) -> Array:
    """Return one over the relative standard deviation of each variance (k,)."""
    return 1.0 / np.sqrt(2.0 / freedom + excess**2)


def _luck(curve: AllanCurve, value: Array, tau: Array, freedom: Array, rng: np.random.Generator) -> Array:
    """Estimated over true variance at each ``tau`` in one simulated recording of the model ``value`` (4,).

    The slow end is simulated as a recording of the same length with fewer samples, the fast end as a piece of it at the
    full rate, whose chance is then scaled down to that of the whole length.
    """
    ratio = rng.chisquare(freedom) / freedom
    thinned = max(1, 2 ** max(0, (curve.samples // SIMULATED).bit_length()))
    n = curve.samples // thinned
    piece = min(curve.samples, SIMULATED)
    for samples, dt_s, share in ((piece, curve.dt_s, piece / curve.samples), (n, curve.dt_s * thinned, 1.0)):
        factors = np.round(tau / dt_s).astype(np.int64)
        usable = (factors >= (1 if share < 1.0 or thinned == 1 else 4)) & (2 * factors + 1 < samples)
        if share < 1.0:
            usable &= factors < 4 * thinned
        if np.any(usable):
            phase = np.concatenate([[0.0], np.cumsum(_simulated(value, samples, dt_s, rng))]) * dt_s
            variances = np.empty(int(usable.sum()))
            overlapping_variance(phase, factors[usable], dt_s, variances)
            chance = variances / np.maximum(_terms(tau[usable]) @ value, 1e-300)
            ratio[usable] = np.maximum(1.0 + (chance - 1.0) * np.sqrt(share), 1e-3)
    return ratio


def _simulated(value: Array, n: int, dt_s: float, rng: np.random.Generator) -> Array:
    """(n,) samples of the model ``value`` (4,), every ``dt_s``, mean taken off."""
    white, flicker, walk, ramp = np.sqrt(value)
    signal = white / np.sqrt(dt_s) * rng.standard_normal(n) + walk * np.sqrt(dt_s) * np.cumsum(rng.standard_normal(n))
    if flicker > 0.0:
        f = np.fft.rfftfreq(4 * n, dt_s)
        shape = np.zeros(len(f))
        shape[1:] = flicker / np.sqrt(2.0 * np.pi * f[1:])  # two-sided density B^2 / (2 pi f)
        signal += np.fft.irfft(shape * np.fft.rfft(rng.standard_normal(4 * n)) * np.sqrt(1.0 / dt_s), 4 * n)[:n]
    signal += ramp * dt_s * np.arange(n)
    return signal - signal.mean()


def _fit(terms: Array, variance: Array, relative: Array) -> Array:
    """Two passes: weights from the data, then from the first fit, so that low points do not attract it."""
    weight = relative / variance
    value = np.zeros(terms.shape[1])
    for _ in range(2):
        scale = np.linalg.norm(terms * weight[:, None], axis=0)
        solution, _ = nnls(terms * weight[:, None] / scale, variance * weight)
        value = solution / scale
        weight = relative / np.maximum(terms @ value, 1e-3 * variance)
    return value


def slope(curve: AllanCurve, low_s: float, high_s: float) -> float:
    """Slope of log deviation over log tau between two averaging times."""
    inside = (curve.tau_s >= low_s * 0.999) & (curve.tau_s <= high_s * 1.001)
    return float(
        np.polyfit(np.log(curve.tau_s[inside]), np.log(curve.deviation[inside]), 1, w=np.sqrt(curve.freedom[inside]))[0]
    )
