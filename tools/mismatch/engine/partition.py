"""Splits a linear twin into two filters so that effects such as a curve can stand between them.

By Bussgang's theorem the best linear twin of a Wiener-Hammerstein circuit has the poles and zeros of both of its
filters; their assignment to the first one is found by trial (J. Sjoberg, J. Schoukens, Automatica 48 (2012) 353). For
each split the input of the second filter is known, and a curve there is linear in its heights.
"""

from __future__ import annotations

import itertools
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.signal import zpk2ss

from sim_devices.physics.effect import Array
from tools.mismatch.engine.fit import Fit
from tools.mismatch.engine.problem import Problem
from tools.mismatch.engine.score import misfits
from tools.mismatch.recording import Recording
from tools.mismatch.twins.dynamic import DynamicTwin
from tools.mismatch.twins.linear import Hold, between_samples, discretise, run_output
from tools.mismatch.twins.make import make

MOST_ORDER = 8
"""Largest number of poles of a twin that is split."""
MOST_SPLITS = 800
SAMPLES = 8000
"""Number of samples on which a split is judged."""
SKIPPED = 0.03
"""Share of these samples that is skipped at the start, where the filters' start states decay."""
KNOTS = (0.05, 0.2, 0.4, 0.6, 0.8, 0.95)
"""Quantiles of the signal at which the tried curve may bend."""
NEARLY_REAL = 0.9
"""Damping ratio above which a pair of poles may represent two real ones, one in each filter."""
LOUD = 4.0
"""Least residual of a linear twin, in noise variances, for which a split is sought."""
ROUNDING = 1e-9
"""Relative size below which coefficients of a numerator are rounding."""
BETTER = 0.5
"""Largest mean square with a curve inside, as a share of that with a curve at either end."""


@dataclass(frozen=True)
class Filter:
    """Holds zeros, poles and gain of a filter."""

    zeros: tuple[complex, ...]
    poles: tuple[complex, ...]
    gain: float

    def matrices(self, hold: Hold) -> tuple[Array, Array, Array, Array]:
        """Return A, B, C, D. Time is in units of the fastest pole, because powers of a rate in rad/s overflow."""
        rate = 1.0 if hold == "discrete" else max((abs(p) for p in self.poles), default=0.0) or 1.0
        zeros, poles = ([q / rate for q in roots] for roots in (self.zeros, self.poles))
        found = zpk2ss(zeros, poles, self.gain * rate ** (len(zeros) - len(poles)))
        a, b, c, d = (np.array(np.real(np.array(m, np.complex128)), np.float64) for m in found)
        return rate * a, rate * b, c, d

    def run(self, u: Array, dt: float, hold: Hold) -> Array:
        """Return the response (n,) from rest to u (n,)."""
        a, b, c, d = self.matrices(hold)
        direct = float(d[0, 0]) * u
        if not self.poles:
            return direct
        step = discretise(a, b[:, 0], dt, hold)
        inside = np.ascontiguousarray(between_samples(u, hold))
        row = np.ascontiguousarray(c[0])
        return direct + run_output(step.ad, step.g0, step.g1, row, inside, np.zeros(1, np.int64))


def splittable(recording: Recording) -> bool:
    """Return True if the twin of a recording is one linear filter that may be written as two."""
    twin = recording.twin
    if twin.kind != "state_space" or twin.effects or recording.segments or {"first", "states"} & set(twin.parameters):
        return False
    order = len(np.atleast_1d(np.asarray(twin.parameters.get("A", ()), object)))
    return len(recording.inputs) * len(recording.outputs) == 1 and 2 <= order <= MOST_ORDER


def split_inside(problem: Problem, raw: Fit, base: Fit) -> Recording | None:
    """Return the recording with its twin written as two filters, or None.

    A curve between the filters must explain far more than one at either end of the chain. ``raw`` is the twin as given;
    a re-fitted one may compensate a curve at one of its ends.
    """
    twin, rec = problem.twin, problem.recording
    if not isinstance(twin, DynamicTwin) or not splittable(rec) or twin.restart or not base.ok:
        return None
    if max(misfits(problem, base).values()) < LOUD:
        return None
    whole = _filter_of(twin, base.theta)
    if not 2 <= len(whole.poles) <= MOST_ORDER:
        return None
    n = min(rec.n, SAMPLES)
    u, y = rec.inputs[twin.inputs[0]][:n], rec.outputs[twin.outputs[0]][:n]
    used = np.flatnonzero(problem.split.fit_mask()[:n])
    judged = np.flatnonzero(problem.split.held_out_mask()[:n])
    used = used[used >= SKIPPED * n]
    if min(used.size, judged.size) < 50 * len(KNOTS):
        return None
    pure = Filter((), (), 1.0)
    given, hold = _filter_of(twin, raw.theta), twin.holds[twin.inputs[0]]
    on = _Trial(u, y, rec.dt, hold, used, judged)
    ends = [_left(on, *s) for s in ((pure, whole), (whole, pure), (pure, given), (given, pure))]
    found: list[tuple[float, int, tuple[Filter, Filter]]] = []
    # a curve inside bends the poles of a re-fitted twin
    for of in dict.fromkeys((whole, given)):
        for pair in itertools.islice(_splits(of, hold, rec.dt), MOST_SPLITS):
            found.append((_left(on, *pair), len(found), pair))
    if not found:
        return None
    left, _, (first, second) = min(found, key=lambda f: f[:2])
    plain = float(np.mean(base.residual[twin.outputs[0]][problem.held_rows] ** 2))
    if not left < BETTER * min(*ends, plain):
        return None
    keys = ("A", "B", "C", "D")
    table = dict(zip(keys, (m.tolist() for m in first.matrices(hold)), strict=True))
    rest = dict(zip(keys, (m.tolist() for m in second.matrices(hold)), strict=True))
    kept = {k: v for k, v in rec.twin.parameters.items() if k in ("hold", "discrete")}
    offset = {"y0": [[float(base.theta[link.j])] for link in twin.links if link.row == -2]}
    split = replace(rec, twin=replace(rec.twin, parameters={**rest, **offset, **kept, "first": table}))
    make(split)
    return split


def _filter_of(twin: DynamicTwin, theta: Array) -> Filter:
    """Return the transfer function of a twin of one input and one output."""
    plant = twin.plant_of(theta)
    c, d = np.zeros((1, plant.a.shape[0])), np.zeros((1, 1))
    for link in twin.links:
        if link.source == twin.inputs[0]:
            if link.row >= 0:
                c[0, link.row] = theta[link.j]
            else:
                d[0, 0] = theta[link.j]
    poles = np.linalg.eigvals(plant.a)
    size = max(float(np.max(np.abs(poles), initial=0.0)), 1e-300)
    numerator = np.real(np.poly(plant.a - plant.b[:, None] @ c) + (d[0, 0] - 1.0) * np.poly(plant.a))
    # powers of a typical rate scale the coefficients to one size; rounding errors are not zeros far away
    scaled = np.abs(numerator) * size ** -np.arange(numerator.size, dtype=np.float64)
    leading = int(np.argmax(scaled > ROUNDING * scaled.max()))
    zeros = np.roots(numerator[leading:])
    return Filter(tuple(complex(z) for z in zeros), tuple(complex(p) for p in poles), float(numerator[leading]))


def _units(roots: Sequence[complex]) -> list[tuple[complex, ...]]:
    """Group roots that belong together: conjugate pairs, and single real ones."""
    size = max((abs(r) for r in roots), default=1.0)
    pairs = [(r, r.conjugate()) for r in roots if r.imag > 1e-9 * size]
    return [*pairs, *((complex(r.real),) for r in roots if abs(r.imag) <= 1e-9 * size)]


def _pole_units(roots: Sequence[complex], hold: Hold, dt: float) -> list[tuple[complex, ...]]:
    """Group poles as ``_units`` does, with strongly damped pairs as two real poles of their size."""
    out: list[tuple[complex, ...]] = []
    for unit in _units(roots):
        p = unit[0]
        if len(unit) == 2:
            s = complex(np.log(p)) / dt if hold == "discrete" else p
            if -s.real > NEARLY_REAL * abs(s):
                r = complex(np.exp(-abs(s) * dt)) if hold == "discrete" else complex(-abs(s))
                out += [(r,), (r,)]
                continue
        out.append(unit)
    return out


def _splits(whole: Filter, hold: Hold, dt: float) -> Iterator[tuple[Filter, Filter]]:
    """Yield every distribution of poles and zeros among two proper filters; the first has a gain of one at rest."""
    poles, zeros = _pole_units(whole.poles, hold, dt), _units(whole.zeros)
    rest = 1.0 if hold == "discrete" else 0.0
    seen: set[tuple[object, ...]] = set()
    for in_first in itertools.product((True, False), repeat=len(poles)):
        first_poles = tuple(p for unit, here in zip(poles, in_first, strict=True) if here for p in unit)
        second_poles = tuple(p for unit, here in zip(poles, in_first, strict=True) if not here for p in unit)
        if not first_poles or not second_poles:
            continue
        for zeros_in_first in itertools.product((True, False), repeat=len(zeros)):
            first_zeros = tuple(z for unit, here in zip(zeros, zeros_in_first, strict=True) if here for z in unit)
            second_zeros = tuple(z for unit, here in zip(zeros, zeros_in_first, strict=True) if not here for z in unit)
            if len(first_zeros) > len(first_poles) or len(second_zeros) > len(second_poles):
                continue
            key = (first_poles, first_zeros)
            if key in seen:
                continue
            seen.add(key)
            at_rest = _value(first_zeros, first_poles, rest)
            if not np.isfinite(at_rest) or abs(at_rest) < 1e-9:
                continue
            all_poles = (*first_poles, *second_poles)
            # separated poles keep the gain at rest
            gain = whole.gain * _value(whole.zeros, whole.poles, rest) / _value(whole.zeros, all_poles, rest)
            yield Filter(first_zeros, first_poles, 1.0 / at_rest), Filter(second_zeros, second_poles, gain * at_rest)


def _value(zeros: Sequence[complex], poles: Sequence[complex], at: float) -> float:
    """Return the value of a transfer function of gain one at a real point."""
    return float(np.real(np.prod([at - z for z in zeros]) / np.prod([at - p for p in poles])))


@dataclass(frozen=True)
class _Trial:
    """Holds what every pair of filters is tried on: input and output (n,), samples that are fitted and that judge."""

    u: Array
    y: Array
    dt: float
    hold: Hold
    used: NDArray[np.int64]
    judged: NDArray[np.int64]


def _left(on: _Trial, first: Filter, second: Filter) -> float:
    """Return the mean square on the judged samples with a fitted curve between two filters."""
    y, dt, hold, used, judged = on.y, on.dt, on.hold, on.used, on.judged
    with np.errstate(all="ignore"):
        x = first.run(on.u, dt, hold)
        if not np.all(np.isfinite(x)) or np.ptp(x) == 0.0:
            return np.inf
        bends = [np.maximum(x - k, 0.0) for k in np.unique(np.quantile(x, KNOTS))]
        columns = [np.ones(y.size), *(second.run(c, dt, hold) for c in (x, *bends))]
        design = np.stack(columns, axis=1)
        if not np.all(np.isfinite(design)):
            return np.inf
        size = np.maximum(np.linalg.norm(design[used], axis=0), 1e-300)
        weights = np.linalg.lstsq(design[used] / size, y[used], rcond=1e-10)[0] / size
        return float(np.mean((y[judged] - design[judged] @ weights) ** 2))
