"""Decides the verdict: agrees, recalibrate, missing physics, unexplained."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from tools.mismatch.engine.fit import Fit
from tools.mismatch.engine.problem import Problem
from tools.mismatch.engine.reach import not_tried
from tools.mismatch.engine.report import Meaning, Verdict
from tools.mismatch.engine.score import fit_rms, held_rms
from tools.mismatch.engine.unexplained import Leftover
from tools.mismatch.placed import Free

OF_THE_CLOCK = frozenset(
    (
        "clock_skew", "dropped_samples", "thermal_drift", "random_walk", "step_shift", "spikes", "mains_interference",
        "vibration",
    )
)  # fmt: skip
"""Effects that occur in time or grow with it; all others are driven by recorded signals."""


@dataclass(frozen=True)
class Decision:
    """Holds the ``verdict`` and its grounds.

    ``p_value``: that nothing is missing; ``meaning`` of an ``unexplained``, "" for other verdicts; ``trouble``:
    failures of the fit, in words; ``floors``: per output the interval of the noise rms; ``doubtful``: outputs whose
    verdict differs between the two ends of that interval.
    """

    verdict: Verdict
    p_value: float
    meaning: Meaning
    trouble: tuple[str, ...]
    floors: dict[str, tuple[float, float]]
    doubtful: tuple[str, ...] = ()


def within_tolerance(problem: Problem, fitted: Fit) -> dict[str, bool]:
    """Return per output if a tolerance is declared and the held-out residual is within it."""
    limits = problem.recording.tolerance
    return {o: o in limits and v <= limits[o] for o, v in held_rms(problem, fitted).items()}


RAN_AWAY = 10.0
"""Residual, in ranges of a recorded output, above which a simulation has diverged."""
WORSE = 1.2
"""Ratio of the held-out residual of the re-fitted twin to that of the twin as given above which the fit failed."""
NOT_HELD = 4.0
"""Ratio of held-out to fitted residual above which the fit does not generalise."""


def fit_trouble(problem: Problem, raw: Fit, base: Fit, fitted: Fit) -> tuple[str, ...]:
    """Return the failures of the fit in words, worst first; empty if it did not fail."""
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
    """Return True if a base parameter is at a finite bound of its range that zero does not explain."""
    ends = [b for b in (p.lo, p.hi) if np.isfinite(b) and b != 0.0]
    return any(abs(value - b) <= 1e-6 * max(abs(b), abs(p.scale)) for b in ends)


def meaning_of(problem: Problem, left: dict[str, Leftover], trouble: Sequence[str]) -> Meaning:
    """Return the meaning of an ``unexplained`` whose residual exceeds the noise at both ends of its interval."""
    if trouble:
        return "fit_failed"
    twin = problem.twin
    follows = any(v.follows for v in left.values())
    if follows and not twin.static and (not_tried(twin) or not twin.feedback_on):
        return "place_not_reachable"
    return "unknown"


def compare_ratio(problem: Problem, fitted: Fit, output: str) -> float:
    """Return the held-out mean square over noise variance."""
    return float(np.mean((fitted.residual[output][problem.held_rows] / problem.sigma(output)) ** 2))
