"""Families of many parameters: what their form may leave over, and specific effects that they hide."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import replace

import numpy as np

from tools.mismatch.engine.fit import Fit
from tools.mismatch.engine.parsimony import freedom
from tools.mismatch.engine.problem import Problem
from tools.mismatch.engine.residual import residuals
from tools.mismatch.engine.revise import reordered, total
from tools.mismatch.engine.score import block_energy, compare, misfits
from tools.mismatch.engine.screen import Candidate, bend, one_step, places
from tools.mismatch.engine.trial import CLEAR_P, Trial
from tools.mismatch.engine.vary import added, beyond_limits, size
from tools.mismatch.engine.workers import mapped
from tools.mismatch.placed import Placed
from tools.mismatch.simulate import Model

EXACT = frozenset(
    (
        "dead_time", "channel_delay", "clock_skew", "dropped_samples", "misalignment", "soft_iron",
        "mains_interference", "vibration", "step_shift", "centripetal_acceleration", "sensor_position_error",
        "current_coupling",
    )
)  # fmt: skip
"""Effects of which there is one form: what they leave is something else."""
FILTERS = frozenset(("first_order_lag", "dead_time", "channel_delay", "resonance"))
"""Linear dynamics: each differs from the next, to first order, by a small delay, which one leaves to another."""
LOOSE = frozenset(("hysteresis", "rate_dependent_hysteresis", "creep", "random_walk", "stribeck_friction"))


def own_form(names: Iterable[str]) -> float:
    """Share of what the named effects took that their true form may leave over."""
    return max((0.004 if n in EXACT else 0.05 if n in LOOSE else 0.015 for n in names), default=0.0)


def key_of(p: Placed) -> tuple[str, ...]:
    """Return what tells one candidate from another."""
    return (*p.effect.form, p.site, p.target)


def in_disguise(trial: Trial) -> bool:
    """Return whether a report figure of the fitted effect is beyond what its physics can be."""
    return trial.fitted is not None and beyond_limits(trial.fitted, trial.placed)


SPECIFIC = 6  # numbers at most of an effect that says something definite
FLEXIBLE = ("hysteresis", "rate_dependent_hysteresis", "creep")


def possible(fitted: Fit) -> bool:
    """Return whether a model came out and every effect of it has figures that its physics can have."""
    return fitted.ok and not any(beyond_limits(fitted, p) for p in fitted.model.placed)


def definite(candidate: Candidate) -> bool:
    """Return whether an effect says something by few numbers, or by events of which its own test is sure."""
    sure = candidate.placed.effect.name in EXACT and candidate.tested and candidate.p_value < CLEAR_P
    return sure or freedom(candidate.placed) <= SPECIFIC


def part_flexible(
    problem: Problem, base: Fit, flexible: Trial, first: Sequence[Trial], jobs: int = 1
) -> tuple[Fit, tuple[Trial, Trial]] | None:
    """Two specific effects in place of one flexible family that took both of them; None when no two do as well."""
    outputs = flexible.placed.outputs
    excess = sum(max(flexible.misfits[o] - 1.0, 0.0) for o in outputs)
    limit = 0.5 * excess if excess > 0.1 else excess
    specific = [
        t
        for t in first
        if t.fitted is not None and t.fitted.ok and t.placed.effect.claims is None
        and t.name not in LOOSE and set(t.placed.outputs) & set(outputs) and not t.refused
        and definite(t.candidate)
    ]  # fmt: skip
    specific.sort(key=lambda t: (sum(t.misfits[o] for o in outputs if o in t.misfits), t.label))
    best: tuple[float, Fit, tuple[Trial, Trial]] | None = None
    by_name: dict[str, Trial] = {}
    for t in specific:
        by_name.setdefault(t.name, t)
    for one in [*by_name.values()][:3]:
        assert one.fitted is not None
        beside = [
            p
            for p in places(problem, [t.placed.effect for t in first if t.name not in LOOSE], one.fitted.model.placed)
            if p.effect.claims is None and set(p.outputs) & set(outputs)
        ]
        unique = list({key_of(p): p for p in beside}.values())
        with np.errstate(all="ignore"):
            bends = bend(problem, one.fitted)
        looked: list[Candidate] = mapped(
            problem, one_step, [(problem, one.fitted, p, bends) for p in unique], jobs, long=False
        )
        # an effect with a test of its own is a candidate where that test is clear
        looked = [c for c in looked if c.share > 0.3 and (not c.tested or c.p_value < CLEAR_P)]
        looked.sort(key=lambda c: (-c.share, c.placed.label))
        others = [c for c in looked if definite(c)][:2]
        pairs: list[Fit] = mapped(problem, added, [(problem, one.fitted, c.placed) for c in others], jobs)
        for other, both in zip(others, pairs, strict=True):
            value = misfits(problem, both)
            left = sum(max(value[o] - 1.0, 0.0) for o in outputs)
            if possible(both) and left <= limit and (best is None or left < best[0]):
                best = (left, both, _two(problem, one, other, both))
    if flexible.name == "rate_dependent_hysteresis":
        for one, other, both, left in beside_a_filter(problem, flexible, first):
            if left <= limit and (best is None or left < best[0]):
                best = (left, both, _two(problem, one, other, both))
    return None if best is None else (best[1], best[2])


def beside_a_filter(
    problem: Problem, flexible: Trial, first: Sequence[Trial]
) -> Iterator[tuple[Trial, Candidate, Fit, float]]:
    """Rate-independent memory beside linear dynamics, which together look like memory that changes with speed: the
    dynamics, the memory as a candidate, the model of both, and what it leaves.
    """
    outputs = flexible.placed.outputs
    filters = [
        t for t in first
        if t.name in FILTERS and t.fitted is not None and t.fitted.ok and set(outputs) <= set(t.placed.outputs)
    ]  # fmt: skip
    filters.sort(key=lambda t: (sum(t.misfits[o] for o in outputs), t.label))
    memory = [t for t in first if t.name == "hysteresis" and set(t.placed.outputs) == set(outputs)]
    for one in filters[:2]:
        assert one.fitted is not None
        for t in memory[:2]:
            with np.errstate(all="ignore"):
                both = added(problem, one.fitted, replace(t.placed, settings={}))
            value = misfits(problem, both)
            if possible(both):
                yield one, t.candidate, both, sum(max(value[o] - 1.0, 0.0) for o in outputs)


def _two(problem: Problem, one: Trial, other: Candidate, both: Fit) -> tuple[Trial, Trial]:
    """The accepted trials of a model of two effects, in the order of the model."""
    assert one.fitted is not None
    value, energy = misfits(problem, both), block_energy(problem, both, problem.held_blocks)
    better = compare(problem, one.fitted, both)
    second = Trial(both.model.placed[-1], other, both, better, value, energy, 0, one.outputs)
    return replace(one, fitted=both, misfits=value, energy=energy), second


def less(problem: Problem, trial: Trial, at: int) -> Fit:
    """The fit of a trial with effect ``at`` of its model taken out and nothing fitted again."""
    assert trial.fitted is not None
    whole = trial.fitted
    model = Model(problem.twin, [p for j, p in enumerate(whole.model.placed) if j != at])
    theta = model.carry(whole.model, whole.theta, problem.recording)
    return replace(whole, model=model, theta=theta, residual=residuals(problem, model, theta))


RATE_FREE = frozenset(("backlash", "dead_zone", "saturation", "static_nonlinearity", "quantization"))
"""What may be the form of a rate-independent memory as well as an effect of its own."""


def beside_flexible(
    problem: Problem, current: Fit, steps: Sequence[Trial], trials: Sequence[Trial], z: float
) -> tuple[Fit, list[Trial]] | None:
    """A specific effect beside a flexible family that had taken both; None when no such pair does clearly better.

    The allowance for a family's form hides a second effect that the family soaked up in part, the more the larger
    the family grew for it. So the second goes first, and the family is read anew off what it leaves: at least half of
    the excess must go (four fifths where the second may be the family's form), or as much with less freedom.
    """
    for k, flexible in enumerate(steps):
        if flexible.name not in FLEXIBLE or flexible.name in {t.name for t in steps[:k]}:
            continue
        outputs = flexible.placed.outputs
        now = misfits(problem, current)
        excess = sum(max(now[o] - 1.0, 0.0) for o in outputs)
        if excess < 0.1:
            continue
        specific = [
            t
            for t in trials
            if t.fitted is not None and t.comparison is not None and not t.refused
            and t.comparison.z > z and t.comparison.gain > 0.04
            and t.placed.effect.claims is None and t.name not in LOOSE and freedom(t.placed) <= SPECIFIC
            and set(t.placed.outputs) & set(outputs) and not in_disguise(t)
        ]  # fmt: skip
        specific.sort(key=lambda t: (sum(t.misfits[o] for o in outputs), t.label))
        at = next(i for i, p in enumerate(current.model.placed) if p.label == flexible.label)
        bare = replace(flexible.placed, settings={})
        found: list[tuple[float, int, str, Fit, Trial]] = []
        with np.errstate(all="ignore"):
            for t in specific[:5]:
                both = added(problem, less(problem, t, at), bare)
                value = misfits(problem, both)
                left = sum(max(value[o] - 1.0, 0.0) for o in outputs)
                count = size(both.model.placed[-1]) + size(t.placed)
                share = 0.2 if t.name in RATE_FREE else 0.75 if count < size(flexible.placed) else 0.5
                if both.ok and left <= share * excess:
                    found.append((left, count, t.label, both, t))
        if found:
            near = min(f[0] for f in found) + 0.03 + 0.1 * excess
            both, t = min((f for f in found if f[0] <= near), key=lambda f: (f[1], f[0], f[2]))[3:]
            # in the order of acceptance, unless the two act on one another
            turned = reordered(problem, both, at)
            in_order = turned.ok and total(problem, turned) <= total(problem, both) + 0.03 + 0.05 * excess
            both = turned if in_order else both
            mine, his = (at, -1) if in_order else (-1, -2)
            energy = block_energy(problem, both, problem.held_blocks)
            value = misfits(problem, both)
            family = replace(flexible, placed=both.model.placed[mine], fitted=both, misfits=value, energy=energy)
            second = replace(t, placed=both.model.placed[his], fitted=both, misfits=value, energy=energy)
            rest_of = [s for i, s in enumerate(steps) if i != k]
            return both, [*rest_of[:k], family, *rest_of[k:], second] if in_order else [*rest_of, second, family]
    return None
