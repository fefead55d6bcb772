"""With seven or eight axes: which one contradicts the others, and going on without it.

The frame's ``parity`` is what the axes beyond six contradict, in deviations of a sample's noise. What calibration
leaves of it is usual and slow. An axis that fails moves it along a direction of its own (its column of ``null``): with
two numbers, eight axes, that tells which; with one it tells only that something is wrong.
"""

from __future__ import annotations

from enum import Enum

import numpy as np
from numpy.typing import NDArray

LIMIT = 7.0
"""Deviations from what is usual; noise alone passes that once in 10^10 samples."""
CLEAR = 3.0
"""Another axis must explain it worse by so many deviations before one is named."""
ACROSS = 3.5
"""What one failing axis may leave across its own direction: noise."""
USUAL_LIMIT = 20.0
"""Calibration leaves one or two deviations; so many are an axis that was wrong from the beginning."""
PATIENCE_TICKS = 25
ALONE_TICKS = 2
"""With one number there is nothing to wait for but a single wrong scan."""
MEMORY_TICKS = 5000
LEARN_TICKS = 100


class Verdict(Enum):
    """``DOUBT``: something contradicts, and which axis it is cannot be told yet. ``UNCLEAR``: nor later."""

    AGREED = "agreed"
    DOUBT = "doubt"
    FOUND = "found"
    UNCLEAR = "unclear"


class Parity:
    """``null`` (M, N): the stage's combinations; ``step`` once a tick, ``axis`` is the one found."""

    def __init__(self, null: NDArray[np.float64]) -> None:
        self.axis = -1
        self.usual = np.zeros(len(null))
        self._ticks = 0
        self._doubt_ticks = 0
        self.restart(null)

    def restart(self, null: NDArray[np.float64]) -> None:
        """Other combinations; what is usual is as good as none (the stage has taken it out)."""
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
        if self._ticks < LEARN_TICKS:  # the first ones are what is usual
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
