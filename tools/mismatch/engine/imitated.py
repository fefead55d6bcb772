"""Finds the places at which an effect is nothing but parameters of the twin under another name."""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np

from sim_devices.physics.effect import Effect
from tools.mismatch.engine.fit import Fit
from tools.mismatch.engine.problem import Problem
from tools.mismatch.engine.screen import Regression, bend, places
from tools.mismatch.simulate import Model
from tools.mismatch.simulate_start import prepare

SAME = 1e-3
"""Share of the response to an effect that finite differences may leave beside the twin's own parameters."""

WEAK = 1e-3
"""Size of the effect, in its scale, whose response is compared."""


def imitated(problem: Problem, base: Fit, effects: Iterable[Effect]) -> frozenset[str]:
    """Return the labels of gains, and of zeros of outputs, that the re-fitted parameters of the twin imitate exactly.

    A gain scales everything behind it, and forces that are added scale with their own sizes. So what the parameters
    imitate beside the twin alone, they imitate beside every set; a search would only find it as a better optimum of a
    set without it. A load is another matter: beside a spring that is not linear its place is no zero.
    """
    found = [p for p in places(problem, (e for e in effects if e.shifts_line), ()) if _is_line(p.effect, p.site)]
    if not found or problem.twin.static:
        return frozenset()
    ground = bend(problem, base)
    design = base.model.design(problem.view, base.theta, samples=ground.samples)
    outputs, linear = problem.twin.outputs, sorted({j for of in design.linear.values() for j in of})
    blocks: list[np.ndarray] = []
    for o in outputs:
        columns = np.zeros((ground.rows.size, len(linear)))
        columns[:, [linear.index(j) for j in design.linear[o]]] = design.columns[o]
        blocks.append(np.column_stack([columns, ground.bends[o]]) / problem.sigma(o))
    known = Regression(blocks)
    out: set[str] = set()
    for place in found:
        placed = prepare(base.model, problem.fit_view, base.theta, place)
        model = Model(problem.twin, (*base.model.placed, placed))
        theta = model.carry(base.model, base.theta, problem.recording)
        before = model.simulate(problem.view, theta)
        theta[model.slices(len(model.placed) - 1)[1]] += WEAK * model.parameters[-1].scale
        after = model.simulate(problem.view, theta)
        change = np.concatenate([(after[o] - before[o])[ground.rows] / problem.sigma(o) for o in outputs])
        if np.linalg.norm(known.less(change)) < SAME * np.linalg.norm(change):
            out.add(place.label)
    return frozenset(out)


def _is_line(effect: Effect, site: str) -> bool:
    return effect.proportional or site == "output"
