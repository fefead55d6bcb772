"""Judges the unexplained rest: the signals that it follows, the strength, and the significance."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from hal.arrays import Array
from sim_devices.physics.effect import Effect
from tools.mismatch.engine.dependence import Dependence, dependences, follows_course
from tools.mismatch.engine.features import Feature, alike, curve, rate_of, standard
from tools.mismatch.engine.fit import Fit
from tools.mismatch.engine.locate import follow, follow_size, tested_features, thinned
from tools.mismatch.engine.problem import Problem
from tools.mismatch.engine.score import winsorised


@dataclass(frozen=True)
class Leftover:
    """Holds the rest of an output.

    ``ratio`` is the residual mean square over noise variance, on held-out or fitted samples, whichever is larger;
    ``follows`` lists the features that
    it follows, strongest first; ``memory_p`` is the p-value of no memory; ``real`` is True if the rest is more than
    noise of any colour.
    """

    output: str
    ratio: float
    follows: tuple[Dependence, ...]
    memory_p: float
    real: bool

    def led_by(self, found: Stranger) -> Leftover:
        """Return the rest with a context signal in front of all other followed features."""
        first = Dependence(found.signal, found.feature, found.p_value, found.share, False)
        return Leftover(self.output, self.ratio, (first, *self.follows), self.memory_p, True)


def leftover(
    problem: Problem, fitted: Fit, output: str, *, p_limit: float = 1e-6, least: float = 0.03, least_size: float = 0.05
) -> Leftover:
    """Judge the rest of an output."""
    s = problem.sigma(output)

    def mean_square(rows: NDArray[np.int64]) -> float:
        r = winsorised(fitted.residual[output][rows], s, problem.lively[rows])
        return float(np.mean((r / s) ** 2))

    # what a fit leaves on its own samples is no less real
    ratio = max(mean_square(problem.held_rows), mean_square(problem.fit_rows))
    found, memory = follow(problem, fitted, output)
    significant = [d for d in found if d.p_value < p_limit and d.strength > least]
    followed = any(d.feature != "time itself" for d in significant)
    if not followed:
        sizes = [d for d in follow_size(problem, fitted, output) if d.p_value < p_limit and d.strength > least_size]
        followed = bool(sizes)
        significant += sizes
    loud = problem.floors[output].declared and ratio > 1.5
    return Leftover(output, ratio, tuple(significant), memory, bool(followed or loud))


@dataclass(frozen=True)
class Stranger:
    """Holds a recorded context signal whose free curve explains the residual better than named effects do.

    ``share`` is the part of the residual's mean square that the curve predicts on held-out blocks.
    """

    output: str
    signal: str
    feature: str
    share: float
    p_value: float


def about(effect: Effect) -> tuple[str, ...]:
    """Return the recorded conditions that an effect uses."""
    return ("actuator_current", "current") if effect.name == "current_coupling" else effect.needs


def context_features(problem: Problem, before: Fit, output: str, names: Iterable[str]) -> tuple[list[Feature], Array]:
    """Return features of a context signal that no effect describes, and the movers alone (n, k).

    The features are an offset by a curve of the signal, and that curve times a mover: the drive, the plant's motion, or
    the rate of either. Such products contain the movers as well.
    """
    _, signals, dt = thinned(problem, before, output)
    drive = problem.twin.drive(output)
    movers = [standard(signals[i]) for i in sorted(problem.twin.inputs, key=lambda i: i != drive)]
    motion = standard(block_means(problem.measured[output] - before.residual[output], dt, problem))
    if not any(alike(motion, m) for m in movers):
        # the gain of a channel acts on a plant's own course, or on a reading that is made of several inputs
        movers.append(motion)
    found: list[Feature] = []
    for name in names:
        bend = curve(signals[name], 10)
        if bend.shape[1] == 0:
            continue
        found.append(Feature(name, "value", bend))
        for m in movers:
            gain, slope = bend * m[:, None], bend * standard(rate_of(m, dt))[:, None]
            found.append(Feature(name, "cross product", np.column_stack([bend, gain])))
            found.append(Feature(name, "cross product with rate", np.column_stack([bend, gain, slope])))
        found.append(Feature(name, "rate", np.column_stack([bend, curve(rate_of(signals[name], dt), 4)])))
    n = next(iter(signals.values())).size
    own = [np.ones((n, 1))]
    for m in movers:
        own += [m[:, None], standard(rate_of(m, dt))[:, None]]
    return found, np.column_stack(own)


def lead(problem: Problem, fitted: Fit, output: str, *, least: float = 0.3, p_limit: float = 1e-8) -> Stranger | None:
    """Return the context signal, not used by a placed effect, that most of the rest follows, if there is one."""
    used = {s for p in fitted.model.placed if output in p.outputs for s in about(p.effect)}
    names = [s for s in problem.recording.context if s not in used]
    return _plainest(problem, fitted, output, names, p_limit, lambda share: share > least)


LEAST_LEAD = 0.1
"""Least share of a residual that a free curve must explain to be a rival of effects."""


def led_by(problem: Problem, fitted: Fit, output: str, course: Array, *, p_limit: float = 1e-3) -> Dependence | None:
    """Return the signal that the ``course`` (m,) of an output follows; None if there is none."""
    e, features = tested_features(problem, replace(fitted, residual={**fitted.residual, output: course}), output)
    found = follows_course(e, [f for f in features if f.kind != "time itself"])
    return next((d for d in found if d.p_value < p_limit and d.strength > LEAST_LEAD), None)


def block_means(x: Array, dt: float, problem: Problem) -> Array:
    """Return ``x`` (m,) on the view, averaged to the step ``dt`` of ``thinned``."""
    k = max(1, round(dt / problem.recording.dt))
    m = x.size // k
    return x[: m * k].reshape(m, k).mean(axis=1)


def _plainest(
    problem: Problem, fitted: Fit, output: str, names: Sequence[str], p_limit: float, enough: Callable[[float], bool]
) -> Stranger | None:
    """Return the simplest feature of the best context signal that explains nearly as much as its best one."""
    if not names:
        return None
    e = thinned(problem, fitted, output)[0]
    features, own = context_features(problem, fitted, output, names)
    beyond = without(e, own)
    # the movers are projected out of both sides (Frisch and Waugh), because a gain contains a share of its mover
    features = [replace(f, columns=without(f.columns, own)) for f in features]
    part = float(np.var(beyond) / max(float(np.var(e)), 1e-300))
    best: Stranger | None = None
    for d in dependences(beyond, features, own_colour=True):
        share = d.strength * part
        close = best is None or (
            best.signal == d.signal and share > 0.95 * best.share and plainer(d.feature, best.feature)
        )
        if d.p_value < p_limit and enough(share) and close:
            best = Stranger(output, d.signal, d.feature, share, d.p_value)
    return best


def without(x: Array, own: Array) -> Array:
    """Return ``x`` (n,) or (n, k) less its projection on the columns of ``own`` (n, j)."""
    size = np.maximum(np.linalg.norm(own, axis=0), 1e-300)
    return x - (own / size) @ np.linalg.lstsq(own / size, x, rcond=1e-8)[0]


_PLAIN = ("value", "rate", "cross product", "cross product with rate")


def plainer(a: str, b: str) -> bool:
    """Return True if feature ``a`` is the simpler statement."""
    return _PLAIN.index(a) < _PLAIN.index(b)
