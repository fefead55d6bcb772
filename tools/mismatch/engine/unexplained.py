"""What is left and fits nothing: what it follows, how strongly, and whether that is enough to say so."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from tools.mismatch.engine.dependence import Dependence, dependences
from tools.mismatch.engine.features import Feature, curve
from tools.mismatch.engine.fit import Fit
from tools.mismatch.engine.locate import follow, follow_size, thinned
from tools.mismatch.engine.problem import Problem
from tools.mismatch.engine.score import winsorised


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
    r = winsorised(fitted.residual[output][problem.held_rows], s)
    ratio = float(np.mean((r / s) ** 2))
    found, memory = follow(problem, fitted, output)
    said = [d for d in found if d.p_value < p_limit and d.strength > least]
    followed = any(d.feature != "time itself" for d in said)
    if not followed:
        sizes = [d for d in follow_size(problem, fitted, output) if d.p_value < p_limit and d.strength > least_size]
        followed = bool(sizes)
        said += sizes
    loud = problem.floors[output].declared and ratio > 1.5
    if loud and not said:
        said = found[:1]
    return Leftover(output, ratio, tuple(said), memory, bool(followed or loud))


@dataclass(frozen=True)
class Stranger:
    """A recorded context signal that a free curve follows better than the named effects do: ``share`` of the base
    residual's mean square that the curve predicts on blocks it has not seen.
    """

    output: str
    signal: str
    feature: str
    share: float
    p_value: float


def stranger(problem: Problem, base: Fit, fitted: Fit, output: str) -> Stranger | None:
    """Does a free curve of a context signal (an offset or a gain by it) explain what the accepted effects do not?

    Only signals that no accepted effect is about, and only when the curve leaves clearly less than the effects.
    """
    used = {s for p in fitted.model.placed if output in p.outputs for s in p.effect.needs}
    context = {s: x for s, x in problem.recording.context.items() if s not in used}
    if not context or not fitted.model.placed:
        return None
    s = problem.sigma(output)
    before = float(np.mean((winsorised(base.residual[output][problem.held_rows], s) / s) ** 2))
    after = float(np.mean((winsorised(fitted.residual[output][problem.held_rows], s) / s) ** 2))
    if after < 1.15:
        return None
    e, signals, _dt = thinned(problem, base, output)
    drive = problem.twin.drive(output)
    best: Stranger | None = None
    for name in context:
        columns = [curve(signals[name])]
        if drive in signals:
            z = (signals[drive] - signals[drive].mean()) / (np.std(signals[drive]) or 1.0)
            columns.append(columns[0] * z[:, None])
        feature = Feature(name, "cross product" if len(columns) > 1 else "value", np.column_stack(columns))
        if feature.columns.shape[1] == 0:
            continue
        found = dependences(e, [feature])[0]
        left = (1 - found.strength) * before
        if found.p_value < 1e-8 and left - 1 < 0.6 * (after - 1) and (best is None or found.strength > best.share):
            best = Stranger(output, name, feature.kind, found.strength, found.p_value)
    return best
