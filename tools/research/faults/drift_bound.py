"""Computes the slowest drift of an accelerometer axis that a detector can see: a bound by Neyman and Pearson.

Six axes and six unknowns leave no parity (erratum 15): a drift can be told from motion only by what is known of the
motion. Given to the detector for nothing: the spectra of hand and noise (a vector autoregression of a healthy run), the
axis, the instant at which the drift begins and its rate. For a known signal in Gaussian noise no test sees it more
often, at a given rate of false alarms, than the matched filter of the whitened readings: with d^2 = sum e' S^-1 e over
the whitened drift e, P(seen) = Phi(d - Phi^-1(1 - P(false))) (S. M. Kay, Fundamentals of Statistical Signal
Processing II, section 4.3). What no detector sees, no firmware can be asked to see.
"""

from __future__ import annotations

import tempfile
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from scipy.stats import norm

from firmware_py.frame import COUNTS
from hal.arrays import Array
from hal.bench import load_bench
from tools.closed_loop.simulate import simulate
from tools.research.faults.campaign import FaultRow
from tools.research.faults.points import POINTS, write_bench

ORDER = 40  # ms of the past from which the hand's next reading is predicted
AXES = 6
SECONDS = 120.0
SETTLED = 5000  # ticks
FALSE_PER_HOUR = 0.01  # a false alarm ends the run
SEEN = 0.99
LATEST_MS = 20.0
DRIFTS = {"sensor: drifts 0.05 V/s": 0.05, "sensor: drifts 1 V/s": 1.0}


@dataclass(frozen=True)
class Whitener:
    """``coefficients`` (ORDER, 6, 6): prediction of a reading from those before it; ``covariance`` (6, 6) in
    V^2 of what is left."""

    coefficients: Array
    covariance: Array

    def signal_to_noise(self, rate_V_per_s: float, axis: int, window_ms: float) -> float:
        """d of a drift of ``axis`` from its first millisecond until ``window_ms`` later."""
        n = int(window_ms)
        ramp = np.zeros((ORDER + n, AXES))
        ramp[ORDER:, axis] = rate_V_per_s * 1e-3 * np.arange(1, n + 1)
        white = ramp[ORDER:].copy()
        for k in range(ORDER):
            white -= ramp[ORDER - 1 - k : ORDER - 1 - k + n] @ self.coefficients[k].T
        return float(np.sqrt(np.sum(white * np.linalg.solve(self.covariance, white.T).T)))


def whitener(readings_V: Array) -> Whitener:
    """Least squares over ``readings_V`` (n, 6) at 1 kHz."""
    x = readings_V - readings_V.mean(0)
    past = np.concatenate([x[ORDER - 1 - k : len(x) - 1 - k] for k in range(ORDER)], axis=1)
    now = x[ORDER:]
    solution = np.linalg.solve(past.T @ past, past.T @ now)
    left = now - past @ solution
    return Whitener(solution.T.reshape(AXES, ORDER, AXES).transpose(1, 0, 2), left.T @ left / len(left))


def seen(d: float, windows_per_hour: float) -> float:
    """Return the probability to see a drift with ``d`` at ``FALSE_PER_HOUR`` false alarms, one decision per window."""
    return float(norm.cdf(d - norm.isf(FALSE_PER_HOUR / windows_per_hour)))


@dataclass(frozen=True)
class DriftBound:
    """``seen_part``: of drifts at ``rate_V_per_s``; ``least_V_per_s``: the slowest that is seen in 99 of 100."""

    point: str
    rate_V_per_s: float
    moved_ms: float
    seen_part: float
    least_V_per_s: float


def drift_bound(bench: Path, point: str, rate_V_per_s: float, moved_ms: float, axis: int = 1) -> DriftBound:
    """``moved_ms``: after so long a drift of that rate has taken the tip 5 um astray; at other rates the tip's error
    grows with the cube of time (two integrations), so it is taken as proportional to rate^(-1/3)."""
    run = simulate(load_bench(bench), SECONDS, keep_frames=True)
    assert run.frames is not None
    lsb_V = run.configs.sensing.lsb_V
    white = whitener(run.frames[SETTLED:, COUNTS : COUNTS + AXES] * lsb_V)

    def part(rate: float) -> float:
        window_ms = moved_ms * (rate_V_per_s / rate) ** (1.0 / 3.0) + LATEST_MS
        return seen(white.signal_to_noise(rate, axis, window_ms), 3.6e6 / window_ms)

    missed, found = 1e-4, 10.0
    for _ in range(30):
        middle = (missed * found) ** 0.5
        missed, found = (middle, found) if part(middle) < SEEN else (missed, middle)
    return DriftBound(point, rate_V_per_s, moved_ms, part(rate_V_per_s), found)


def drift_bounds(bench: Path, rows: Sequence[FaultRow]) -> list[DriftBound]:
    """Return bounds for each drift and hand of a campaign on ``bench``, from the median time to 5 um."""
    bounds: list[DriftBound] = []
    with tempfile.TemporaryDirectory(prefix="micron-drift-") as folder:
        for row in rows:
            moved = [o.moved_ms for o in row.observations if o.moved_ms is not None]
            rate = DRIFTS.get(row.fault.name)
            if rate is not None and moved:
                point = next(p for p in POINTS if p.name == row.point)
                file = write_bench(bench, point, Path(folder))
                bounds.append(drift_bound(file, row.point, rate, float(np.median(moved))))
    return bounds
