"""Two plants fitted to a recording of a stack, of other model classes than ours: our inverse is tried on them.

Both run freely: they see the drive alone. ``preisach`` sums Krasnosel'skii-Pokrovskii hysterons, which make a Preisach
model with continuous relays (Banks, Kurdila and Webb 1997); no weight is negative. ``narx`` is a recurrent polynomial
whose terms in |du| give it memory (Martins and Aguirre 2016), fitted to its own free run. Behind each of them are a
dead time and a first-order lag, which the fit chooses.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy.optimize import least_squares, nnls
from scipy.signal import lfilter

from hal.arrays import Array
from hal.compiled import kernel

LEVELS = 20
TERMS = 9
SKIP = 200
DELAYS = (1, 2)
LAGS = (1.0, 1.5, 2.0, 2.5, 3.0)
"""Dead times and time constants that are tried, in samples."""


@dataclass(frozen=True)
class Plant:
    """A fitted plant: ``run`` gives the displacement um (n,) of a drive V (n,); ``rms_um`` is what its fit leaves."""

    name: str
    run: Callable[[Array], Array]
    rms_um: float


def late(x: Array, delay: int, lag: float) -> Array:
    """(n, ...) ``x`` after a dead time and a first-order lag, both in samples, at rest at ``x[0]``."""
    keep = np.exp(-1.0 / lag)
    moved = np.concatenate([np.repeat(x[:1], delay, axis=0), x[: len(x) - delay]]) - x[0]
    return x[0] + np.asarray(lfilter([1.0 - keep], [1.0, -keep], moved, axis=0), dtype=np.float64)


@kernel
def hysterons(drive: Array, alpha: Array, beta: Array, width: float) -> Array:
    """(n, m) outputs 0 to 1 of ramps that rise from ``alpha`` and fall to ``beta`` (V), for a drive from 0 V."""
    out = np.empty((len(drive), len(alpha)))
    y = np.zeros(len(alpha))
    for k in range(len(drive)):
        for i in range(len(alpha)):
            up = min(max((drive[k] - alpha[i]) / width, 0.0), 1.0)
            down = min(max((drive[k] - beta[i]) / width, 0.0), 1.0)
            y[i] = max(up, min(down, y[i]))
            out[k, i] = y[i]
    return out


@kernel
def recurrent(x: Array, theta: Array, start: float) -> Array:
    """(n,) free run of the polynomial on the normalised drive ``x``."""
    out = np.empty(len(x))
    h = start
    before = x[0]
    for k in range(len(x)):
        u = x[k]
        step = u - before
        size = abs(step)
        h += step * (theta[0] + theta[1] * u + theta[2] * h + theta[3] * u * u)
        h += size * (theta[4] + theta[5] * u + theta[6] * h + theta[7] * u * h + theta[8] * u * u)
        # a trial of the fit that runs away shall be a bad one, not an infinite one
        h = min(max(h, -10.0), 10.0)
        before = u
        out[k] = h
    return out


def preisach(drive: Array, z: Array) -> Plant:
    """Fit hysterons to a drive V (n,) and a displacement um (n,)."""
    top = float(drive.max())
    grid: Array = np.linspace(0.0, top, LEVELS + 1)[:-1]
    width = top / LEVELS
    pairs = [(a, b) for i, a in enumerate(grid) for b in grid[: i + 1]]
    alpha, beta = (np.ascontiguousarray(v) for v in np.array(pairs).T)

    ours = hysterons(drive, alpha, beta, width)

    def solved(delay: int, lag: float, thin: int) -> tuple[float, Array]:
        a = late(ours, delay, lag)[SKIP::thin]
        # the offset is minus and plus a column of ones
        a = np.column_stack([a, np.ones(len(a)), -np.ones(len(a))])
        q = np.asarray(np.linalg.qr(np.column_stack([a, z[SKIP::thin]]), mode="r"), dtype=np.float64)
        found: Any = nnls(q[:, :-1], q[:, -1], maxiter=20 * a.shape[1])
        return float(found[1]) / np.sqrt(len(a)), np.asarray(found[0], dtype=np.float64)

    _, delay, lag = min((solved(d, t, 5)[0], d, t) for d in DELAYS for t in LAGS)
    _, weights = solved(delay, lag, 1)

    def run(u: Array) -> Array:
        return late(hysterons(u, alpha, beta, width) @ weights[:-2], delay, lag) + (weights[-2] - weights[-1])

    return Plant("Preisach", run, float(np.std((z - run(drive))[SKIP:])))


def narx(drive: Array, z: Array) -> Plant:
    """Fit the recurrent polynomial to a drive V (n,) and a displacement um (n,)."""
    middle, half = 0.5 * (drive.max() + drive.min()), 0.5 * np.ptp(drive)
    centre, span = float(np.mean(z)), 0.5 * float(np.ptp(z[SKIP:]))

    def simulated(u: Array, p: Array, delay: int, lag: float) -> Array:
        return centre + span * late(recurrent((u - middle) / half, p[:TERMS], p[TERMS]), delay, lag)

    def fitted(delay: int, lag: float) -> tuple[float, Array]:
        def residual(p: Array) -> Array:
            return (z - simulated(drive, p, delay, lag))[SKIP:]

        first = np.zeros(TERMS + 1)
        first[0], first[6], first[TERMS] = 1.0, -0.1, (z[0] - centre) / span
        found: Any = least_squares(residual, first, max_nfev=30, x_scale=0.1)
        p = np.asarray(found.x, dtype=np.float64)
        return float(np.std(residual(p))), p

    _, delay, lag = min((fitted(1, lag)[0], 1, lag) for lag in LAGS)
    _, p = fitted(delay, lag)

    def run(u: Array) -> Array:
        return simulated(u, p, delay, lag)

    return Plant("NARX", run, float(np.std((z - run(drive))[SKIP:])))
