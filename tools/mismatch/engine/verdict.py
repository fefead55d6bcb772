"""The verdict: agrees, recalibrate, missing physics, unexplained."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from tools.mismatch.engine.colour import ljung_box
from tools.mismatch.engine.families import EXACT
from tools.mismatch.engine.fit import Fit
from tools.mismatch.engine.noise import floor_interval
from tools.mismatch.engine.parsimony import Rule
from tools.mismatch.engine.problem import Problem
from tools.mismatch.engine.reach import not_tried
from tools.mismatch.engine.report import Meaning, Verdict
from tools.mismatch.engine.score import compare, fit_rms, held_rms
from tools.mismatch.engine.selection import Selection
from tools.mismatch.engine.unexplained import Leftover, lone_event
from tools.mismatch.placed import Free

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


FAR_ABOVE = 50.0
"""Mean square over noise variance (seven times the noise) that goes with recorded signals: however small a share of the
mismatch it is, a verdict that only names effects would hide it."""
LOUD = 9.0
"""Mean square over noise variance that no colour of noise accounts for, even when nothing is known to follow it."""
OF_THE_CLOCK = frozenset(
    (
        "clock_skew", "dropped_samples", "thermal_drift", "random_walk", "step_shift", "spikes", "mains_interference",
        "vibration",
    )
)  # fmt: skip
"""Effects that come with time or grow with it; all others are driven by recorded signals."""


@dataclass(frozen=True)
class Decision:
    """``verdict``; ``p_value`` that nothing is missing; ``meaning`` of an ``unexplained``, "" for other verdicts;
    ``trouble``: in words, what went wrong in the fit; ``floors``: per output the interval of the noise rms;
    ``doubtful``: outputs whose verdict is another at the two ends of that interval.
    """

    verdict: Verdict
    p_value: float
    meaning: Meaning
    trouble: tuple[str, ...]
    floors: dict[str, tuple[float, float]]
    doubtful: tuple[str, ...] = ()


def judge(
    problem: Problem, raw: Fit, base: Fit, selection: Selection, left: dict[str, Leftover], rule: Rule
) -> Decision:
    """The verdict that holds over the whole interval of the noise floor and matters to the user.

    What named effects leave, and what nothing explains, is held against a twin only where it stands above the upper
    end; what no effect explains and only the lower end calls real is ``unexplained`` with a doubtful floor. Differences
    within the declared tolerance count as none.
    """
    floors = {
        o: floor_interval(
            problem.floors[o],
            selection.fitted.residual[o][problem.held_rows],
            max((d.strength for d in v.follows), default=0.0) if v.real else 0.0,
            1 / problem.recording.dt,
        )
        for o, v in left.items()
    }
    within = within_tolerance(problem, raw)
    if all(within.values()):
        return Decision("agrees", 1.0, "", (), floors)
    low, p = decide(problem, raw, base, selection, left, rule)
    trouble = fit_trouble(problem, raw, base, selection.fitted) if low == "unexplained" else ()
    if low != "unexplained" or selection.strange is not None:
        return Decision(low, p, meaning_of(problem, left, trouble) if low == "unexplained" else "", trouble, floors)
    quiet = {o: within_tolerance(problem, selection.fitted).get(o, False) for o in left}
    raised = {o: max(hi / problem.sigma(o), 1.0) for o, (_, hi) in floors.items()}
    loud = problem.with_floors({o: replace(f, rms=f.rms * raised[o]) for o, f in problem.floors.items()})
    above = {
        o: replace(v, ratio=v.ratio / raised[o] ** 2, real=v.real and not quiet[o])
        for o, v in left.items()
        if not (quiet[o] and selection.steps)
    }
    if not above:
        return Decision("missing_physics", p, "", (), floors)
    high, _ = decide(loud, raw, base, selection, above, rule)
    if high == "unexplained":
        return Decision(low, p, meaning_of(problem, left, trouble), trouble, floors)
    doubtful = tuple(o for o in left if raised[o] > 1.0 and left[o].ratio > 1.3)
    if selection.steps or not any(v.real for v in above.values()):
        return Decision(high, p if selection.steps else 1.0, "", (), floors, doubtful)
    return Decision(low, p, "floor_doubtful", trouble, floors, doubtful)


def within_tolerance(problem: Problem, fitted: Fit) -> dict[str, bool]:
    """Per output: whether a tolerance is declared and the held-out residual is within it."""
    limits = problem.recording.tolerance
    return {o: o in limits and v <= limits[o] for o, v in held_rms(problem, fitted).items()}


RAN_AWAY = 10.0
"""Times the range of a recorded output beyond which a simulation is no account of it."""
WORSE = 1.2
"""Held-out residual of the re-fitted twin over that of the twin as given, above which the fit failed."""
NOT_HELD = 4.0
"""Held-out over fitted residual above which what was fitted does not hold elsewhere."""


def fit_trouble(problem: Problem, raw: Fit, base: Fit, fitted: Fit) -> tuple[str, ...]:
    """Return what went wrong in the fit, in words, worst first; empty when the fit holds."""
    out: list[str] = []
    given, alone, final = held_rms(problem, raw), held_rms(problem, base), held_rms(problem, fitted)
    seen = fit_rms(problem, fitted)
    for o in problem.twin.outputs:
        size = float(np.ptp(problem.measured[o]))
        if not np.isfinite(final[o]) or final[o] > RAN_AWAY * size:
            out.append(f"the fitted simulation of {o} runs away from the recording")
        elif min(alone[o], final[o]) > WORSE * given[o]:
            out.append(f"re-fitting makes {o} worse on held-out data than the parameters as given")
        elif final[o] > NOT_HELD * seen[o] and final[o] > 2.0 * problem.sigma(o):
            out.append(f"{o} is {final[o] / seen[o]:.1f} times worse on held-out data than where it was fitted")
    stuck = [
        p.name
        for p, v in zip(fitted.model.parameters[: fitted.model.n_base], fitted.theta, strict=False)
        if at_end(p, v)
    ]
    if stuck:
        out.append(f"base parameters ended at a limit of the search: {', '.join(stuck)}")
    return tuple(out)


def at_end(p: Free, value: float) -> bool:
    """Return whether a base parameter sits at a finite end of its range that zero does not explain."""
    ends = [b for b in (p.lo, p.hi) if np.isfinite(b) and b != 0.0]
    return any(abs(value - b) <= 1e-6 * max(abs(b), abs(p.scale)) for b in ends)


def meaning_of(problem: Problem, left: dict[str, Leftover], trouble: Sequence[str]) -> Meaning:
    """Return what an ``unexplained`` means whose residual stands above the noise wherever in its interval that lies."""
    if trouble:
        return "fit_failed"
    twin = problem.twin
    follows = any(v.follows for v in left.values())
    if follows and not twin.static and (not_tried(twin) or not twin.feedback_on):
        return "place_not_reachable"
    return "unknown"


def decide(
    problem: Problem, raw: Fit, base: Fit, selection: Selection, left: dict[str, Leftover], rule: Rule
) -> tuple[Verdict, float]:
    """The verdict at one noise floor, and the p-value that nothing is missing."""
    if selection.strange is not None:
        return "unexplained", selection.strange.p_value
    if selection.steps:
        p = min(float(np.exp(s.comparison.log_p)) for s in selection.steps if s.comparison)
        p = min(1.0, p * max(len(selection.first), 1))  # every candidate that was looked at (Bonferroni)
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
        if worst.real and not walks and worst.ratio > FAR_ABOVE:
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
