"""How well a fitted model predicts samples that no fit has seen: a Student-t density of the free run's residual.

The scale is the one that maximises the density on the fitted samples, so that a fit that only follows its own samples
pays for it on the others.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.stats import t as student

from tools.mismatch.engine.features import curve
from tools.mismatch.engine.fit import Fit
from tools.mismatch.engine.problem import Problem
from tools.mismatch.engine.projected import robust_scale
from tools.mismatch.placed import Placed

Array = NDArray[np.float64]

DEGREES = 5.0
"""Degrees of freedom: tails that heavy-tailed noise has."""
_CONSTANT = math.lgamma((DEGREES + 1) / 2) - math.lgamma(DEGREES / 2) - 0.5 * math.log(DEGREES * math.pi)
NORMAL_SCALE = 0.8527
"""Scale of the best such density of normal noise of unit rms (by quadrature)."""
NORMAL = -1.4371
"""Mean log density of normal noise of unit rms under the best such density (by quadrature)."""
LATTICE = 0.1
"""Least scale in units of the lattice that readings sit on: beside an edge a reading may fall on either side."""
LEAST = 0.05
"""Least scale in units of the noise floor: a residual that is exactly zero is no infinite evidence."""


def student_scale(r: Array, least: float) -> float:
    """Maximum-likelihood scale of centred Student-t samples ``r`` (n,) (Lange et al. 1989)."""
    s = max(1.4826 * float(np.median(np.abs(r))), least)
    for _ in range(12):
        weight = (DEGREES + 1) / (DEGREES + (r / s) ** 2)
        s = max(float(np.sqrt(np.mean(weight * r * r))), least)
    return s


def student_log_density(r: Array, scale: float) -> Array:
    """Log density (n,) of each of ``r``, in nats."""
    return _CONSTANT - math.log(scale) - 0.5 * (DEGREES + 1) * np.log1p((r / scale) ** 2 / DEGREES)


def undone(problem: Problem, fitted: Fit, output: str, placed: Sequence[int]) -> Array:
    """The residual (m,) of ``output`` with the fitted courses of the effects ``placed`` put back into it."""
    model, theta = fitted.model, fitted.theta.copy()
    for k in placed:
        _, weights = model.slices(k)
        theta[weights] = 0.0
    return problem.measured[output] - model.simulate(problem.view, theta, (output,))[output]


def prediction(problem: Problem, fitted: Fit, output: str) -> tuple[Array, Array]:
    """Errors of the prediction of every sample (m,), and their standard deviations up to a common factor (m,).

    The free run alone predicts, unless an effect of the set is noise with a law of its own: then what the samples
    before a sample say of it by that law is part of its prediction.
    """
    model = fitted.model
    laws = [k for k, p in enumerate(model.placed) if p.effect.predict is not None and output in p.outputs]
    r = fitted.residual[output]
    if not laws:
        return r, np.ones(r.size)
    law = model.placed[laws[0]].effect.predict
    assert law is not None
    learned = np.zeros(r.size, np.bool_)
    learned[problem.fit_rows] = True
    believed = learned.copy()
    believed[problem.held_rows] = True
    usual = ~model.excused(problem.view, output)
    gap_s = np.diff(problem.index, prepend=problem.index[:1]) * problem.recording.dt
    # noise of the instrument that runs on from sample to sample is not the law's to predict
    least = problem.sigma(output)
    return law(undone(problem, fitted, output, laws), gap_s, believed & usual, learned & usual, least)


def unpredicted(problem: Problem, fitted: Fit) -> Fit:
    """``fitted`` with what nothing predicts as its residual: by the law of its noise where it has one, and without the
    samples that are events of their own."""
    left: dict[str, Array] = {}
    for o in problem.twin.outputs:
        error, deviation = prediction(problem, fitted, o)
        left[o] = np.where(fitted.model.excused(problem.view, o), 0.0, error / deviation)
    return replace(fitted, residual=left)


COLOUR = 8
"""Samples before a sample from which what a law could not predict is tried once more."""


def predictable(problem: Problem, e: Array) -> float:
    """Nats per held-out sample by which an autoregression, learned on the fitted samples, predicts what the law of
    noise could not: innovations ``e`` (m,) are white where the law holds."""
    limit = 6.0 * robust_scale(e[problem.fit_rows], 1e-300)
    e = np.clip(e, -limit, limit)
    learned = np.zeros(e.size, np.bool_)
    learned[problem.fit_rows] = True
    held = problem.held_rows
    before, after = float(np.mean(e[held] ** 2)), float(np.mean(innovations(e, learned)[held] ** 2))
    return 0.5 * math.log(before / after) if before > after > 0.0 else 0.0


KNOTS = 10
"""Knots of the curve of a recorded signal that what is independent must not follow."""


def recorded(problem: Problem, fitted: Fit, output: str) -> list[Array]:
    """Curves (m, k) of every input and condition, and of what is simulated of ``output``."""
    r = problem.recording
    signals = [x[problem.index] for of in (r.inputs, r.context) for x in of.values()]
    signals.append(problem.measured[output] - fitted.residual[output])
    return [c for c in (curve(x, KNOTS) for x in signals) if c.shape[1]]


def innovations(e: Array, learned: NDArray[np.bool_]) -> Array:
    """What an autoregression, learned on the samples ``learned``, does not predict of ``e`` (both (m,))."""
    limit = 6.0 * robust_scale(e[learned], 1e-300)
    clipped = np.clip(e, -limit, limit)
    past = np.column_stack([np.concatenate([np.zeros(k), clipped[:-k]]) for k in range(1, COLOUR + 1)])
    return e - past @ np.linalg.lstsq(past[learned], clipped[learned], rcond=None)[0]


def follower(problem: Problem, fitted: Fit, output: str, figures: Callable[[Placed], int]) -> bool:
    """Whether a curve of one recorded signal, with the colour of what it leaves, says more about ``output`` than the
    effects there which depend on nothing that is recorded (a walk, steps, a drift in time), each with its price
    (Schwarz 1978). ``figures``: how many numbers an effect brings."""
    own = [
        k
        for k, p in enumerate(fitted.model.placed)
        if output in p.outputs and not p.effect.driven and not p.effect.needs and p.effect.claims is None
    ]
    if not own:
        return False
    learned = np.zeros(problem.index.size, np.bool_)
    learned[problem.fit_rows] = True
    learned &= ~fitted.model.excused(problem.view, output)
    least = NORMAL_SCALE * problem.sigma(output)
    one = 0.5 * math.log(max(int(np.count_nonzero(learned)), 2))

    def nats(e: Array, deviation: Array | float = 1.0) -> float:
        d = student_log_density(e[learned], student_scale(e[learned], least))
        return float(np.sum(d - np.log(np.broadcast_to(deviation, e.shape)[learned])))

    error, deviation = prediction(problem, fitted, output)
    e = error / deviation
    with_it = max(nats(e, deviation), nats(innovations(e, learned), deviation))
    with_it -= one * sum(figures(fitted.model.placed[k]) for k in own)
    r = undone(problem, fitted, output, own)
    bare = max(with_it, nats(innovations(r - np.median(r[learned]), learned)))
    for columns in recorded(problem, fitted, output):
        design = np.column_stack([np.ones(r.size), columns])
        size = np.maximum(np.linalg.norm(design[learned], axis=0), 1e-300)
        weight = np.linalg.lstsq(design[learned] / size, r[learned], rcond=1e-8)[0] / size
        rest = r - design @ weight
        if max(nats(rest), nats(innovations(rest, learned))) - one * columns.shape[1] > bare:
            return True
    return False


TAILS = (1.0, 1.5, 2.0, 3.0, 4.0, 6.0, 10.0, 30.0)
"""Degrees of freedom of Student-t tails that noise without events may have."""


def gain_of_events(r: Array, events: NDArray[np.bool_], span: float, least: float) -> float:
    """Nats by which residuals ``r`` (n,) are likelier as a mixture of noise and of ``events`` (n,), which are anywhere
    within their own largest size and within ``span``, than as noise alone, each with the tails that suit it best."""
    share = float(np.mean(events))
    if not 0.0 < share < 1.0:
        return 0.0
    span = min(span, 2.0 * float(np.max(np.abs(r[events]))))

    def tails(x: Array) -> float:
        def total(nu: float) -> float:
            s = max(1.4826 * float(np.median(np.abs(x))), least)
            for _ in range(20):
                s = max(float(np.sqrt(np.mean((nu + 1) / (nu + (x / s) ** 2) * x * x))), least)
            return float(np.sum(student.logpdf(x, nu, scale=s)))

        return max(total(nu) for nu in TAILS)

    event = math.log(share) - math.log(max(span, 1e-300))
    usual = tails(r[~events]) + float(np.sum(~events)) * math.log1p(-share)
    return usual + float(np.sum(events)) * event - tails(r)


@dataclass(frozen=True)
class Weighed:
    """``density`` (m,) log density of every sample of an output; of a law of noise the share of samples that it is free
    to follow (``free``: trace of its smoother, Harvey 1989, section 4.5), and what an autoregression predicts of what
    it could not (``predictable``, nats per sample). Both are 0 without one."""

    density: Array
    free: float = 0.0
    predictable: float = 0.0


def weigh(problem: Problem, fitted: Fit) -> dict[str, Weighed]:
    """The log densities of all samples of the view, per output.

    A sample that an effect takes as its own event is predicted by nothing but the range of the recording: it pays the
    density of a uniform distribution over it, and what it takes to say that it is an event; the others pay what it
    takes to say that they are none (a mixture: R. K. Pearson, Mining Imperfect Data, 2005, section 3.2).
    """
    out: dict[str, Weighed] = {}
    best = best_log_density(problem)
    for o in problem.twin.outputs:
        error, deviation = prediction(problem, fitted, o)
        e = error / deviation
        excused = fitted.model.excused(problem.view, o)
        usual = problem.fit_rows[~excused[problem.fit_rows]]
        floor = problem.floors[o]
        least = max(LEAST * floor.rms, LATTICE * floor.step, 1e-300)
        lawful = bool(np.any(deviation > 1.0))
        if lawful:
            least = max(least, NORMAL_SCALE * problem.sigma(o))
        d = student_log_density(e, student_scale(e[usual] if usual.size else e, least)) - np.log(deviation)
        share = float(np.mean(excused))
        if share > 0.0:
            event = math.log(share) - math.log(max(float(np.ptp(problem.measured[o])), 1e-300))
            d = np.where(excused, event, d + math.log(max(1.0 - share, 1e-300)))
        free = more = 0.0
        if lawful:
            # what a law makes of the colour of the instrument's own noise is no credit to it
            d = d - max(float(np.mean(d[problem.held_rows])) - best[o], 0.0)
            gain = 1.0 - deviation[problem.held_rows] ** -2.0
            free = float(np.mean(gain / (2.0 - gain)))
            more = predictable(problem, np.where(excused, 0.0, e))
        out[o] = Weighed(d, free, more)
    return out


def best_log_density(problem: Problem) -> Mapping[str, float]:
    """The mean log density per output that normal noise at the floor would have: no model predicts much better."""
    return {o: NORMAL - math.log(max(problem.sigma(o), 1e-300)) for o in problem.twin.outputs}


def exact_log_density(problem: Problem) -> Mapping[str, float]:
    """The log density per output that readings on a lattice would have whose every value is predicted."""
    out: dict[str, float] = {}
    for o in problem.twin.outputs:
        floor = problem.floors[o]
        least = max(LEAST * floor.rms, LATTICE * floor.step, 1e-300)
        out[o] = _CONSTANT - math.log(least) if floor.step > 0.0 else -math.inf
    return out
