"""Finds the places at which an effect is nothing but parameters of the twin under another name."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence

import numpy as np

from sim_devices.physics.effect import Effect
from tools.mismatch.engine.fit import Fit
from tools.mismatch.engine.problem import Problem
from tools.mismatch.engine.screen import STEP, Regression, bend, places
from tools.mismatch.placed import Placed
from tools.mismatch.simulate import Model
from tools.mismatch.simulate_start import prepare

SAME = 1e-3
"""Share of the response to an effect that finite differences may leave beside the twin's own parameters."""

STEPS = (STEP, 1e-5)
"""Changes of a parameter, relative to its size, whose responses are compared. Over the large one a mode that hardly
decays is not linear; over the small one a program with a solver of its own shows that solver's errors."""


def imitated(problem: Problem, base: Fit, effects: Iterable[Effect]) -> frozenset[str]:
    """Return the labels of gains, linear forces and zeros of outputs that the re-fitted parameters imitate exactly.

    A gain scales everything behind it, and forces that are added scale with their own sizes. So what the parameters
    imitate beside the twin alone, they imitate beside every set; a search would only find it as a better optimum of a
    set without it. A load is another matter: beside a spring that is not linear its place is no zero.
    """
    found = [p for p in places(problem, (e for e in effects if e.shifts_line), ()) if _is_line(p.effect, p.site)]
    if not found or problem.twin.static:
        return frozenset()
    return frozenset(label for step in STEPS for label in _imitated(problem, base, found, step))


def _imitated(problem: Problem, base: Fit, found: Sequence[Placed], step: float) -> Iterator[str]:
    """Yield the labels of those places whose response to a small ``step`` is that of parameters of the twin."""
    ground = bend(problem, base, step)
    design = base.model.design(problem.view, base.theta, samples=ground.samples)
    outputs, linear = problem.twin.outputs, sorted({j for of in design.linear.values() for j in of})
    blocks: list[np.ndarray] = []
    for o in outputs:
        columns = np.zeros((ground.rows.size, len(linear)))
        columns[:, [linear.index(j) for j in design.linear[o]]] = design.columns[o]
        blocks.append(np.column_stack([columns, ground.bends[o]]) / problem.sigma(o))
    known = Regression(blocks)
    for place in found:
        placed = prepare(base.model, problem.fit_view, base.theta, place)
        model = Model(problem.twin, (*base.model.placed, placed))
        theta = model.carry(base.model, base.theta, problem.recording)
        before = model.simulate(problem.view, theta)
        weights, changes = model.slices(len(model.placed) - 1)[1], list[np.ndarray]()
        for j in range(weights.start, weights.stop):
            moved = theta.copy()
            moved[j] += step * model.parameters[j].scale
            after = model.simulate(problem.view, moved)
            changes.append(np.concatenate([(after[o] - before[o])[ground.rows] / problem.sigma(o) for o in outputs]))
        # the further weights are a constant, which is an effect of its own
        first, *others = (known.less(c) for c in changes)
        if others:
            beside = np.column_stack(others)
            first = first - beside @ np.linalg.lstsq(beside, first)[0]
        if np.linalg.norm(first) < SAME * np.linalg.norm(changes[0]):
            yield place.label


def _is_line(effect: Effect, site: str) -> bool:
    return effect.proportional or site == "output"
