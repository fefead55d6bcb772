"""What is left and fits nothing: what it follows, how strongly, and whether that is enough to say so."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from sim_devices.physics.effect import Effect
from tools.mismatch.engine.dependence import Dependence, dependences
from tools.mismatch.engine.features import Feature, alike, curve, rate_of, standard
from tools.mismatch.engine.fit import Fit
from tools.mismatch.engine.locate import follow, follow_size, thinned
from tools.mismatch.engine.problem import Problem
from tools.mismatch.engine.score import winsorised

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Leftover:
    """Per output: ``ratio`` residual mean square over noise variance on held-out samples, ``follows`` what the
    residual follows (strongest first), ``memory_p`` the p-value that history adds nothing, ``real`` whether it
    is more than noise of whatever colour.
    """

    output: str
    ratio: float
    follows: tuple[Dependence, ...]
    memory_p: float
    real: bool

    def led_by(self, found: Stranger) -> Leftover:
        """The same with a context signal in front of everything else that is followed."""
        first = Dependence(found.signal, found.feature, found.p_value, found.share, False)
        return Leftover(self.output, self.ratio, (first, *self.follows), self.memory_p, True)


def leftover(
    problem: Problem, fitted: Fit, output: str, *, p_limit: float = 1e-6, least: float = 0.03, least_size: float = 0.05
) -> Leftover:
    """Judge what one output has left."""
    s = problem.sigma(output)
    r = winsorised(fitted.residual[output][problem.held_rows], s, problem.lively[problem.held_rows])
    ratio = float(np.mean((r / s) ** 2))
    found, memory = follow(problem, fitted, output)
    said = [d for d in found if d.p_value < p_limit and d.strength > least]
    followed = any(d.feature != "time itself" for d in said)
    if not followed:
        sizes = [d for d in follow_size(problem, fitted, output) if d.p_value < p_limit and d.strength > least_size]
        followed = bool(sizes)
        said += sizes
    loud = problem.floors[output].declared and ratio > 1.5
    return Leftover(output, ratio, tuple(said), memory, bool(followed or loud))


@dataclass(frozen=True)
class Stranger:
    """A recorded context signal that a free curve follows better than named effects do: ``share`` of the residual's
    mean square that the curve predicts on blocks it has not seen.
    """

    output: str
    signal: str
    feature: str
    share: float
    p_value: float


def about(effect: Effect) -> tuple[str, ...]:
    """Recorded conditions that an effect is about."""
    return ("actuator_current", "current") if effect.name == "current_coupling" else effect.needs


def context_features(problem: Problem, before: Fit, output: str, names: Iterable[str]) -> tuple[list[Feature], Array]:
    """Return what a context signal may do that no effect is about: an offset by a curve of it, and that curve times the
    drive, the plant's motion, or the rate of either. And what these do on their own (n, k): such products hold it too.
    """
    _, signals, dt = thinned(problem, before, output)
    drive = problem.twin.drive(output)
    movers = [standard(signals[i]) for i in sorted(problem.twin.inputs, key=lambda i: i != drive)]
    motion = standard(block_means(problem.measured[output] - before.residual[output], dt, problem))
    if not any(alike(motion, m) for m in movers):
        # a plant's own course, or a reading made of several inputs: the gain of a channel acts on it
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
    """The context signal, about which no placed effect is, that most of what is left follows, if there is one."""
    used = {s for p in fitted.model.placed if output in p.outputs for s in about(p.effect)}
    names = [s for s in problem.recording.context if s not in used]
    return _plainest(problem, fitted, output, names, p_limit, lambda share: share > least)


def block_means(x: Array, dt: float, problem: Problem) -> Array:
    """``x`` (m,) on the view, averaged to the step ``dt`` of ``thinned``."""
    k = max(1, round(dt / problem.recording.dt))
    m = x.size // k
    return x[: m * k].reshape(m, k).mean(axis=1)


def _plainest(
    problem: Problem, fitted: Fit, output: str, names: Sequence[str], p_limit: float, enough: Callable[[float], bool]
) -> Stranger | None:
    """Of the features of the context signal that takes most, the plainest that takes nearly as much."""
    if not names:
        return None
    e = thinned(problem, fitted, output)[0]
    features, own = context_features(problem, fitted, output, names)
    beyond = without(e, own)
    # both sides less what the movers do on their own (Frisch and Waugh): a gain holds a share of its mover
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
    """``x`` (n,) or (n, k) less its projection on the columns of ``own`` (n, j)."""
    size = np.maximum(np.linalg.norm(own, axis=0), 1e-300)
    return x - (own / size) @ np.linalg.lstsq(own / size, x, rcond=1e-8)[0]


_PLAIN = ("value", "rate", "cross product", "cross product with rate")


def plainer(a: str, b: str) -> bool:
    """Is feature ``a`` the simpler statement."""
    return _PLAIN.index(a) < _PLAIN.index(b)
