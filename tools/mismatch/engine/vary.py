"""Varies a fitted set of effects: one left out or one more; counts an effect's parameters."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace

from sim_devices.physics.effect import Array
from tools.mismatch.engine.fit import Fit, fit
from tools.mismatch.engine.problem import Problem
from tools.mismatch.engine.residual import residuals
from tools.mismatch.placed import Placed
from tools.mismatch.simulate import Model
from tools.mismatch.simulate_joint import in_balance
from tools.mismatch.simulate_start import prepare, starts


def reduced(problem: Problem, fitted: Fit, drop: int) -> Fit:
    """Return the fit without one of its effects, everything else fitted again."""
    placed = [p for j, p in enumerate(fitted.model.placed) if j != drop]
    model = Model(problem.twin, placed)
    theta = model.carry(fitted.model, fitted.theta, problem.recording)
    return fit(
        problem, model, [theta], stride=2, iterations=12, keep=fitted,
        touched=fitted.model.together(fitted.model.placed[drop].outputs),
    )  # fmt: skip


def stripped(problem: Problem, fitted: Fit, drop: Callable[[Placed], bool]) -> Fit:
    """Return the fit without the effects that ``drop`` selects, everything else as it is."""
    model = Model(problem.twin, [p for p in fitted.model.placed if not drop(p)])
    theta = model.carry(fitted.model, fitted.theta, problem.recording)
    return replace(fitted, model=model, theta=theta, residual=residuals(problem, model, theta))


def added(problem: Problem, current: Fit, place: Placed) -> Fit:
    """Return the fit with one more effect, from its own starting points."""
    placed = prepare(current.model, problem.fit_view, current.theta, place)
    model = Model(problem.twin, (*current.model.placed, placed))
    theta = model.carry(current.model, current.theta, problem.recording)
    begin = with_balance(problem, model, starts(model, len(model.placed) - 1, problem.fit_view, theta))
    return fit(problem, model, begin, stride=2, iterations=12, keep=current, touched=placed.outputs)


def with_balance(problem: Problem, model: Model, begin: Sequence[Array]) -> list[Array]:
    """Return the starts of a set of two or more effects, led by the first one fitted to the equations of motion."""
    together = in_balance(model, problem.fit_view, begin[0]) if len(model.placed) > 1 else None
    return [*begin] if together is None else [together, *begin]


def beyond_limits(fitted: Fit, placed: Placed) -> tuple[str, ...]:
    """Return the human parameters of a fitted effect that are outside their physical ranges."""
    limits, forbidden = placed.effect.limits, placed.effect.forbidden
    if not limits and not forbidden:
        return ()
    found = fitted.model.human(fitted.theta)[placed.label]
    outside = [h.name for h in found if h.name in limits and not limits[h.name][0] <= h.value <= limits[h.name][1]]
    outside += [h.name for h in found if any(a <= h.value <= b for a, b in forbidden.get(h.name, ()))]
    return tuple(outside)


def size(placed: Placed) -> int:
    """Return the number of parameters that an effect brings, including events read off the data."""
    parts = placed.parts
    events = sum(len(placed.settings.get(key, ())) for key in ("at", "shift", "times_s", "starts"))
    return len(parts.nonlinear) + len(parts.weights) + events
