"""The verdict: agrees, recalibrate, missing physics, unexplained."""

from __future__ import annotations

import numpy as np

from tools.mismatch.engine.colour import ljung_box
from tools.mismatch.engine.families import EXACT
from tools.mismatch.engine.fit import Fit
from tools.mismatch.engine.parsimony import Rule
from tools.mismatch.engine.problem import Problem
from tools.mismatch.engine.report import Verdict
from tools.mismatch.engine.score import compare
from tools.mismatch.engine.select import Selection
from tools.mismatch.engine.unexplained import Leftover, lone_event

MUCH = 5.0
"""Mean square over noise variance beyond what the colour of noise adds to a floor that was read off its quiet end."""
WANDERS = 0.1
"""Share of what a random walk leaves that must follow a recorded signal before it is held against the walk: nobody
predicts a walk, so what it leaves on held-out data says nothing by itself."""


def beyond_form(selection: Selection) -> float:
    """Share of the mismatch that no form of the named effects accounts for: more than that is something else.

    What foreign forms of rightly named effects leave stays below 0.055, what imitations leave starts at 0.065.
    """
    return 0.03 if all(s.name in EXACT for s in selection.steps) else 0.06


LOUD = 9.0
"""Mean square over noise variance that no colour of noise accounts for, even when nothing is known to follow it."""
OF_THE_CLOCK = frozenset(
    (
        "clock_skew", "dropped_samples", "thermal_drift", "random_walk", "step_shift", "spikes", "mains_interference",
        "vibration",
    )
)  # fmt: skip
"""Effects that come with time or grow with it; all others are driven by recorded signals."""


def decide(
    problem: Problem, raw: Fit, base: Fit, selection: Selection, left: dict[str, Leftover], rule: Rule
) -> tuple[Verdict, float]:
    """The verdict and the p-value that nothing is missing."""
    if selection.strange is not None:
        return "unexplained", selection.strange.p_value
    if selection.steps:
        p = min(float(np.exp(s.comparison.log_p)) for s in selection.steps if s.comparison)
        worst = max(left.values(), key=lambda v: v.ratio)
        before = max(compare_ratio(problem, base, o) for o in left)
        left_over = (worst.ratio - 1) / max(before - 1, 1e-9)
        walks = any(s.name == "random_walk" and worst.output in s.placed.outputs for s in selection.steps)
        if walks and not any(d.signal != "time" and d.strength > WANDERS and d.p_value < 1e-4 for d in worst.follows):
            return "missing_physics", p
        grids = [s.placed for s in selection.steps if s.name == "quantization" and worst.output in s.placed.outputs]
        if grids:
            # readings beside an edge of the grid fall on either side, and nobody knows on which
            step = max(problem.floors[worst.output].step, *(g.settings["step"][0] for g in grids))
            if worst.ratio * problem.sigma(worst.output) ** 2 < step**2 / 12:
                return "missing_physics", p
        if worst.real and left_over > 0.3 and worst.ratio > 1.3:
            return "unexplained", p
        if worst.real and not walks and worst.ratio > 2.0 and left_over > beyond_form(selection):
            return "unexplained", p
        if not walks and worst.ratio > MUCH and left_over > 0.1:
            return "unexplained", p
        return "missing_physics", p
    if any(v.real and v.ratio > 1.05 for v in left.values()):
        p = min((d.p_value for v in left.values() for d in v.follows), default=1.0)
        return "unexplained", p
    if any(lone_event(problem, base, o) for o in left):
        return "unexplained", 1e-6
    loud = [o for o, v in left.items() if v.ratio > LOUD and ljung_box(base.residual[o][problem.held_rows]) < 1e-6]
    if loud:
        return "unexplained", 1e-6
    moved = compare(problem, raw, base)
    if moved.z > rule.z and moved.gain > rule.gain:
        return "recalibrate", 1.0
    return "agrees", 1.0


def compare_ratio(problem: Problem, fitted: Fit, output: str) -> float:
    """Held-out mean square over noise variance."""
    return float(np.mean((fitted.residual[output][problem.held_rows] / problem.sigma(output)) ** 2))
