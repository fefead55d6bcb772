"""Finds, with seven or eight axes, the axis that contradicts the others, so that sensing can go on without it.

The frame's ``parity`` is the residual of the axes beyond six, in standard deviations of a sample's noise. Calibration
errors leave a slowly varying part of it, called usual. An axis that fails moves it along a direction of its own (its
column of ``null``): two residuals (eight axes) tell which axis that is; one tells only that something is wrong.
"""

from __future__ import annotations

from enum import Enum

import numpy as np
from numpy.typing import NDArray

LIMIT = 7.0
"""Largest norm of the difference from the usual residual, in standard deviations. Noise alone exceeds it once in
10^10 samples."""
CLEAR = 3.0
"""Margin, in standard deviations, by which every other axis must explain the residual worse before one is named."""
ACROSS = 3.5
"""Largest residual across an axis' own direction, in standard deviations, that is noise if this axis fails alone."""
USUAL_LIMIT = 20.0
"""Largest norm of the usual residual, in standard deviations. Calibration leaves one or two; beyond this limit an axis
was wrong from the beginning."""
PATIENCE_TICKS = 25
ALONE_TICKS = 2
"""Patience with one residual only: the wait need only outlast a single wrong scan."""
MEMORY_TICKS = 5000
LEARN_TICKS = 100


class Verdict(Enum):
    """Names the result of a step. ``DOUBT``: the axes contradict, and which one is wrong cannot be told yet.
    ``UNCLEAR``: it will not be told later either."""

    AGREED = "agreed"
    DOUBT = "doubt"
    FOUND = "found"
    UNCLEAR = "unclear"


class Parity:
    """Watches the parity residuals for a failing axis. ``null`` (M, N): the stage's combinations; ``step`` is to be
    called once a tick; ``axis`` is the axis found, -1 before."""

    def __init__(self, null: NDArray[np.float64]) -> None:
        self.axis = -1
        self.usual = np.zeros(len(null))
        self._ticks = 0
        self._doubt_ticks = 0
        self.restart(null)

    def restart(self, null: NDArray[np.float64]) -> None:
        """Use other combinations ``null``. The usual residual starts at zero, because the stage has taken it out."""
        size = np.linalg.norm(null, axis=0)
        self._directions = null / np.where(size > 0.0, size, 1.0)
        self._known = np.flatnonzero(size > 0.0)
        self._single = len(null) < 2 or not null[1].any()
        self.usual[:] = 0.0
        self._doubt_ticks = 0

    def step(self, parity: NDArray[np.float64]) -> Verdict:
        off = parity - self.usual
        if self._single:
            off[1] = 0.0
        if self._ticks < LEARN_TICKS:  # the first residuals define what is usual
            self._ticks += 1
            self.usual += off / self._ticks
            return Verdict.AGREED
        if float(self.usual @ self.usual) > USUAL_LIMIT**2:
            return Verdict.UNCLEAR
        if float(off @ off) <= LIMIT**2:
            self.usual += off / MEMORY_TICKS
            self._doubt_ticks = 0
            return Verdict.AGREED
        self._doubt_ticks += 1
        if not self._single:
            across = np.abs(off[0] * self._directions[1] - off[1] * self._directions[0])[self._known]
            best, second = np.argsort(across)[:2]
            if across[best] < ACROSS and across[second] - across[best] > CLEAR:
                self.axis = int(self._known[best])
                return Verdict.FOUND
        patience = ALONE_TICKS if self._single else PATIENCE_TICKS
        return Verdict.UNCLEAR if self._doubt_ticks > patience else Verdict.DOUBT
