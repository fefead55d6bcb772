"""Prepares the model that a corrected twin is written from: events of the recording are removed and it is re-solved."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

from tools.mismatch.apply import EVENTS
from tools.mismatch.engine.fit import SEARCH_ROWS, Fit
from tools.mismatch.engine.problem import Problem
from tools.mismatch.engine.projected import Projected
from tools.mismatch.engine.residual import residuals
from tools.mismatch.simulate import Model


def without_events(problem: Problem, fitted: Fit) -> Fit:
    """Return ``fitted`` without its events, with linear parameters solved again.

    An offset that was fitted beside a jump of the level is not the offset of a run without the jump.
    """
    kept = [p for p in fitted.model.placed if p.effect.name not in EVENTS]
    if len(kept) == len(fitted.model.placed):
        return fitted
    model = Model(problem.twin, kept)
    theta = model.carry(fitted.model, fitted.theta, problem.recording)
    _, theta = Projected(problem, model, problem.twin.outputs, SEARCH_ROWS).evaluate(theta)
    return replace(fitted, model=model, theta=theta, residual=residuals(problem, model, theta))


def raw_values(fitted: Fit) -> Mapping[str, Mapping[str, float]]:
    """Return the parameters of each effect by its label, under the names of a twin file."""
    out: dict[str, Mapping[str, float]] = {}
    for k, placed in enumerate(fitted.model.placed):
        a, b = fitted.model.slices(k)
        at = (*range(a.start, a.stop), *range(b.start, b.stop))
        out[placed.label] = {fitted.model.parameters[i].name.rsplit(".", 1)[-1]: float(fitted.theta[i]) for i in at}
    return out
