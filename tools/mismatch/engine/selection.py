"""Holds what a search selected, in the form that a report is assembled from."""

from __future__ import annotations

from dataclasses import dataclass, field

from tools.mismatch.engine.fit import Fit
from tools.mismatch.engine.problem import Problem
from tools.mismatch.engine.trial import Trial
from tools.mismatch.engine.unexplained import Stranger


@dataclass(frozen=True)
class Selection:
    """``problem`` with the noise floors as they were found on the way, ``fitted`` the model with everything accepted,
    ``steps`` the accepted trials in order, ``rivals`` per step the other acceptable trials, best first; ``first`` all
    trials against the recalibrated base.
    """

    problem: Problem
    base: Fit
    fitted: Fit
    steps: tuple[Trial, ...]
    rivals: tuple[tuple[Trial, ...], ...]
    first: tuple[Trial, ...] = field(default=())
    strange: Stranger | None = None
    """A context signal whose free curve does better than the next effect would have done: the search ended there."""
