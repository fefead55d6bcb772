"""The model that a corrected twin is written from: without what happened in one recording, fitted on all of it."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

from tools.mismatch.apply import EVENTS
from tools.mismatch.engine.fit import SEARCH_ROWS, Fit, fit
from tools.mismatch.engine.problem import Problem
from tools.mismatch.engine.projected import Projected
from tools.mismatch.engine.residual import residuals
from tools.mismatch.engine.split import Split
from tools.mismatch.engine.trust import fit_loss
from tools.mismatch.simulate import Model
from tools.mismatch.twins.cascade import CascadeTwin
from tools.mismatch.twins.corrected import CorrectedTwin
from tools.mismatch.twins.dynamic import DynamicTwin
from tools.mismatch.twins.ode import OdeTwin


def exported_fit(problem: Problem, fitted: Fit) -> Fit:
    """The fit that a twin file is written from: ``fitted`` without events, on every sample of the recording.

    What was held out has chosen and judged the model by then; to leave it out of the parameters would waste it. A
    ``test`` part that the recording names is not touched.
    """
    kept = without_events(problem, fitted)
    if not problem.split.own:
        return kept
    every = on_every_sample(problem)
    model = Model(every.twin, kept.model.placed)
    before = fit_loss(every, residuals(every, model, kept.theta))
    again = fit(every, model, [kept.theta], iterations=15)
    if not again.ok or fit_loss(every, again.residual) > before:
        return kept
    return replace(kept, theta=again.theta, residual=residuals(problem, kept.model, again.theta))


def on_every_sample(problem: Problem) -> Problem:
    """The same problem with nothing held out, in the one run that a twin file is used for."""
    twin, split = problem.twin, problem.split
    if twin.restart and isinstance(twin, DynamicTwin | CorrectedTwin | OdeTwin | CascadeTwin):
        twin = replace(twin, restart=False)
    begin = min(a for a, _ in (*split.fit, *split.held_out))
    return replace(problem, twin=twin, split=Split(split.n, ((begin, split.n),), (), (), ()), hints=())


def without_events(problem: Problem, fitted: Fit) -> Fit:
    """``fitted`` without its events. Its linear parameters are solved again: an offset that was fitted beside a level
    that jumps is not the offset of a run without the jump.
    """
    kept = [p for p in fitted.model.placed if p.effect.name not in EVENTS]
    if len(kept) == len(fitted.model.placed):
        return fitted
    model = Model(problem.twin, kept)
    theta = model.carry(fitted.model, fitted.theta, problem.recording)
    _, theta = Projected(problem, model, problem.twin.outputs, SEARCH_ROWS).evaluate(theta)
    return replace(fitted, model=model, theta=theta, residual=residuals(problem, model, theta))


def raw_values(fitted: Fit) -> Mapping[str, Mapping[str, float]]:
    """Parameters of each effect by its label, under the names that a twin file gives them."""
    out: dict[str, Mapping[str, float]] = {}
    for k, placed in enumerate(fitted.model.placed):
        a, b = fitted.model.slices(k)
        at = (*range(a.start, a.stop), *range(b.start, b.stop))
        out[placed.label] = {fitted.model.parameters[i].name.rsplit(".", 1)[-1]: float(fitted.theta[i]) for i in at}
    return out
