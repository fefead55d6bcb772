"""Measures how well a fitted model predicts held-out samples: a Student-t density of the free run's residual.

The scale maximises the density on the fitted samples, so that overfitting lowers the density on the others.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray
from scipy.stats import t as student

from hal.arrays import Array
from tools.mismatch.engine.features import curve, standard
from tools.mismatch.engine.fit import Fit
from tools.mismatch.engine.intervals import before_rounding
from tools.mismatch.engine.problem import Problem
from tools.mismatch.engine.projected import robust_scale
from tools.mismatch.placed import Placed

DEGREES = 5.0
"""Degrees of freedom of the density, as heavy-tailed noise has them."""
_CONSTANT = math.lgamma((DEGREES + 1) / 2) - math.lgamma(DEGREES / 2) - 0.5 * math.log(DEGREES * math.pi)
NORMAL_SCALE = 0.8527
"""Scale of the Student-t density that fits normal noise of unit rms best (by quadrature)."""
NORMAL = -1.4371
"""Mean log density of normal noise of unit rms under the best Student-t density (by quadrature)."""
LATTICE = 0.1
"""Least scale in steps of the lattice of readings: beside an edge a reading may fall on either side."""
LEAST = 0.05
"""Least scale in units of the noise floor. It keeps the evidence of an exactly zero residual finite."""


def student_scale(r: Array, least: float) -> float:
    """Return the maximum-likelihood scale of centred Student-t samples ``r`` (n,) (Lange et al. 1989)."""
    s = max(1.4826 * float(np.median(np.abs(r))), least)
    for _ in range(12):
        weight = (DEGREES + 1) / (DEGREES + (r / s) ** 2)
        s = max(float(np.sqrt(np.mean(weight * r * r))), least)
    return s


def student_log_density(r: Array, scale: float) -> Array:
    """Return the log density (n,) of each of ``r``, in nats."""
    return _CONSTANT - math.log(scale) - 0.5 * (DEGREES + 1) * np.log1p((r / scale) ** 2 / DEGREES)


def undone(problem: Problem, fitted: Fit, output: str, placed: Sequence[int]) -> Array:
    """Return the residual (m,) of ``output`` with the fitted courses of the effects ``placed`` added back.

    A course is taken before it is rounded: the difference of two rounded readings follows all that they contain.
    """
    smooth = before_rounding(problem, fitted)
    chosen = [fitted.model.placed[k] for k in placed]
    theta = smooth.theta.copy()
    for k, p in enumerate(smooth.model.placed):
        if p in chosen:
            theta[smooth.model.slices(k)[1]] = 0.0
    without = smooth.model.simulate(problem.view, theta, (output,))[output]
    if smooth is fitted:
        return problem.measured[output] - without
    whole = smooth.model.simulate(problem.view, smooth.theta, (output,))[output]
    return fitted.residual[output] + whole - without


def prediction(problem: Problem, fitted: Fit, output: str) -> tuple[Array, Array]:
    """Return the prediction errors of all samples (m,), and their standard deviations up to a common factor (m,).

    The free run alone predicts, unless an effect of the set is noise with a predictor (``Effect.predict``): then its
    one-step prediction from the previous samples is included.
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
    # the predictor must not take credit for coloured noise of the instrument
    least = problem.sigma(output)
    return law(undone(problem, fitted, output, laws), gap_s, believed & usual, learned & usual, least)


def unpredicted(problem: Problem, fitted: Fit) -> Fit:
    """Return ``fitted`` with its unpredicted part as residual.

    One-step predictions of effects that are noise are removed, and so are samples that are events.
    """
    left: dict[str, Array] = {}
    for o in problem.twin.outputs:
        error, deviation = prediction(problem, fitted, o)
        left[o] = np.where(fitted.model.excused(problem.view, o), 0.0, error / deviation)
    return replace(fitted, residual=left)


COLOUR = 8
"""Order of the autoregression that tests the prediction errors for remaining colour."""


def predictable(problem: Problem, e: Array) -> float:
    """Return the nats per held-out sample by which an autoregression improves the prediction errors ``e`` (m,).

    It is learned on the fitted samples. Innovations are white if the law of the noise holds. Errors that are not finite
    where they count, of a model that diverges there, obey no law: then the improvement is infinite.
    """
    if not np.all(np.isfinite(e[np.r_[problem.fit_rows, problem.held_rows]])):
        return math.inf
    e = np.where(np.isfinite(e), e, 0.0)
    limit = 6.0 * robust_scale(e[problem.fit_rows], 1e-300)
    e = np.clip(e, -limit, limit)
    learned = np.zeros(e.size, np.bool_)
    learned[problem.fit_rows] = True
    held = problem.held_rows
    before, after = float(np.mean(e[held] ** 2)), float(np.mean(innovations(e, learned)[held] ** 2))
    return 0.5 * math.log(before / after) if before > after > 0.0 else 0.0


KNOTS = 10
"""Number of knots of the curve of a recorded signal that an independent effect must not follow."""


def recorded(problem: Problem, fitted: Fit, output: str) -> list[Array]:
    """Return curves (m, k) of every input and condition and of the simulated ``output``, and all inputs together.

    A curve of a condition stands alone and beside its product with the simulated output: a gain that follows it. Wrong
    gains of several inputs follow all of them and none alone.
    """
    r = problem.recording
    simulated = problem.measured[output] - fitted.residual[output]
    motion = standard(simulated)[:, None]
    conditions = [c for x in r.context.values() if (c := curve(x[problem.index], KNOTS)).shape[1]]
    courses = [x[problem.index] for x in r.inputs.values()] + [simulated]
    plain = [c for x in courses if (c := curve(x, KNOTS)).shape[1]]
    gains = [np.column_stack([standard(x[problem.index]) for x in r.inputs.values()])] if len(r.inputs) > 1 else []
    return [*plain, *gains, *conditions, *(np.column_stack([c, c * motion]) for c in conditions)]


def innovations(e: Array, learned: NDArray[np.bool_]) -> Array:
    """Return the innovations (m,) of ``e`` by an autoregression that is learned on the samples ``learned`` (m,)."""
    limit = 6.0 * robust_scale(e[learned], 1e-300)
    clipped = np.clip(e, -limit, limit)
    past = np.column_stack([np.concatenate([np.zeros(k), clipped[:-k]]) for k in range(1, COLOUR + 1)])
    return e - past @ np.linalg.lstsq(past[learned], clipped[learned], rcond=None)[0]


@dataclass(frozen=True)
class Evidence:
    """Measures the log likelihood of the fitted samples ``learned`` (m,) of an output, one step ahead.

    ``least`` is the least scale of a residual, ``price`` the nats of one parameter (Schwarz 1978).
    """

    learned: NDArray[np.bool_] = field(repr=False)
    least: float
    price: float

    @staticmethod
    def of(problem: Problem, fitted: Fit, output: str) -> Evidence:
        """Return the evidence on the samples of ``output`` that are no events of ``fitted``."""
        learned = np.zeros(problem.index.size, np.bool_)
        learned[problem.fit_rows] = True
        learned &= ~fitted.model.excused(problem.view, output)
        price = 0.5 * math.log(max(int(np.count_nonzero(learned)), 2))
        return Evidence(learned, NORMAL_SCALE * problem.sigma(output), price)

    def nats(self, e: Array, deviation: Array | float = 1.0) -> float:
        """Return the log likelihood of the prediction errors ``e`` (m,) with standard deviations ``deviation``."""
        e_in = e[self.learned]
        d = student_log_density(e_in, student_scale(e_in, self.least))
        return float(np.sum(d - np.log(np.broadcast_to(deviation, e.shape)[self.learned])))

    def one_step(self, problem: Problem, fitted: Fit, output: str) -> float:
        """Return the log likelihood of ``fitted``, whose errors are white or coloured, whichever is likelier."""
        error, deviation = prediction(problem, fitted, output)
        e = error / deviation
        return max(self.nats(e, deviation), self.nats(innovations(e, self.learned), deviation))


def walks(fitted: Fit, output: str) -> list[int]:
    """Return the places in a set of the effects on ``output`` that are noise with a law of their own."""
    return [k for k, p in enumerate(fitted.model.placed) if p.effect.predict is not None and output in p.outputs]


def priced_likelihood(problem: Problem, fitted: Fit, output: str, figures: Callable[[Placed, Fit], float]) -> float:
    """Return the log likelihood of ``output`` one step ahead, less the price of its effects (Schwarz 1978).

    The rest is white or coloured, whichever is likelier. ``figures`` returns the number of parameters of an effect.
    """
    evidence = Evidence.of(problem, fitted, output)
    size = sum(figures(p, fitted) for p in fitted.model.placed if output in p.outputs)
    return evidence.one_step(problem, fitted, output) - evidence.price * size


def follower(problem: Problem, fitted: Fit, output: str, figures: Callable[[Placed, Fit], float]) -> bool:
    """Return True if a curve of a recorded signal explains ``output`` better than its signal-independent effects.

    Such effects are a walk, steps and a drift in time. The curve counts with the colour of its residual, and each
    alternative pays for its parameters (Schwarz 1978). ``figures`` returns the number of parameters of an effect.
    """
    own = [
        k
        for k, p in enumerate(fitted.model.placed)
        if output in p.outputs and p.effect.is_independent and p.effect.claims is None
    ]
    if not own:
        return False
    evidence = Evidence.of(problem, fitted, output)
    learned, nats, one = evidence.learned, evidence.nats, evidence.price
    with_it = evidence.one_step(problem, fitted, output)
    with_it -= one * sum(figures(fitted.model.placed[k], fitted) for k in own)
    r = undone(problem, fitted, output, own)
    if not np.all(np.isfinite(r)):
        return False  # without them the simulation runs away, and no curve of a signal makes up for that
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
"""Degrees of freedom of the Student-t tails of noise without events that are tried."""


def gain_of_events(r: Array, events: NDArray[np.bool_], span: float, least: float) -> float:
    """Return the nats by which ``r`` (n,) is more likely as a mixture of noise and ``events`` (n,) than as noise.

    Events are uniform within their own largest size and within ``span``; each hypothesis has its best tails.
    """
    share = float(np.mean(events))
    if not 0.0 < share < 1.0:
        return 0.0
    span = min(span, 2.0 * float(np.max(np.abs(r[events]))))

    def tails(x: Array) -> tuple[float, float, float]:
        def total(nu: float) -> tuple[float, float, float]:
            s = max(1.4826 * float(np.median(np.abs(x))), least)
            for _ in range(20):
                s = max(float(np.sqrt(np.mean((nu + 1) / (nu + (x / s) ** 2) * x * x))), least)
            return float(np.sum(student.logpdf(x, nu, scale=s))), nu, s

        return max(total(nu) for nu in TAILS)

    event = math.log(share) - math.log(max(span, 1e-300))
    usual, nu, scale = tails(r[~events])
    # of a burst the samples beside its peak may be noise
    within = student.logpdf(r[events], nu, scale=scale) + math.log1p(-share)
    usual += float(np.sum(~events)) * math.log1p(-share)
    return usual + float(np.sum(np.maximum(within, event))) - tails(r)[0]


@dataclass(frozen=True)
class Weighed:
    """Holds the log ``density`` (m,) of the samples of an output, and the figures of an effect that is noise.

    ``free`` is the share of samples that the effect is free to follow (trace of its smoother, Harvey 1989, section
    4.5); ``predictable`` is the gain of an autoregression on its errors, nats per sample. Both are 0 without one.
    """

    density: Array
    free: float = 0.0
    predictable: float = 0.0


def weigh(problem: Problem, fitted: Fit) -> dict[str, Weighed]:
    """Return the log densities of all samples of the view, per output.

    A sample that an effect claims as an event has the density of a uniform distribution over the range of the
    recording and the log probability of an event; the others have that of no event (a mixture: R. K. Pearson, Mining
    Imperfect Data, 2005, section 3.2).
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
            # a predictor gets no credit for the colour of the instrument's own noise
            d = d - max(float(np.mean(d[problem.held_rows])) - best[o], 0.0)
            gain = 1.0 - deviation[problem.held_rows] ** -2.0
            free = float(np.mean(gain / (2.0 - gain)))
            more = predictable(problem, np.where(excused, 0.0, e))
        out[o] = Weighed(d, free, more)
    return out


def best_log_density(problem: Problem) -> Mapping[str, float]:
    """Return the mean log density per output of normal noise at the floor, which hardly any model exceeds."""
    return {o: NORMAL - math.log(max(problem.sigma(o), 1e-300)) for o in problem.twin.outputs}


def exact_log_density(problem: Problem) -> Mapping[str, float]:
    """Return the log density per output of readings on a lattice of which every value is predicted."""
    out: dict[str, float] = {}
    for o in problem.twin.outputs:
        floor = problem.floors[o]
        least = max(LEAST * floor.rms, LATTICE * floor.step, 1e-300)
        out[o] = _CONSTANT - math.log(least) if floor.step > 0.0 else -math.inf
    return out
