"""Finds faults in a column of time stamps, read in blocks, with the limits of the loader."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from hal.arrays import Array
from tools.mismatch.recording_clock import LONGEST_GAP, MOST_MISSING

MOST_PLACES = 5
_PART = 256
"""Number of stamps of a part: its earliest and latest, against an even grid, stand for it if the grid is corrected."""
UNEVEN = 0.5
"""Steps that differ from the usual one by more than this share are counted as uneven."""


@dataclass(frozen=True)
class Stamps:
    """Summarises time stamps in seconds.

    ``step_s``: the usual step; without a fault the mean one, because the usual one is rounded like the stamps.
    ``rate_hz``: None without a step. ``places``: the first ``MOST_PLACES`` faults, each with its sample and time;
    ``faults``: how many there are. ``is_usable``: the loader takes the column as it is. ``wander``: largest distance of
    a stamp from the even grid between the first and the last, in steps, as the loader measures it.
    """

    step_s: float
    rate_hz: float | None
    places: tuple[str, ...]
    faults: int
    is_usable: bool
    wander: float

    @property
    def is_even(self) -> bool:
        """Return True if a rate is equivalent to the stamps."""
        return self.is_usable and not self.faults and self.wander < 0.5


@dataclass
class StampReader:
    """Collects ``Stamps`` from block after block. ``first_row``: the line of sample 0 in a text file, else 0."""

    first_row: int = 0
    _usual: float = 0.0
    _last: float = float("nan")
    _begin: float = float("nan")
    _count: int = 0
    _missing_s: float = 0.0
    _longest: float = 0.0
    _back: int = 0
    _faults: int = 0
    _places: list[str] = field(default_factory=list[str])
    _grid_step: float = 0.0
    _off: list[Array] = field(default_factory=list[Array])
    """Middle samples of the parts, and least and largest distances of their stamps from a grid of ``_grid_step``."""

    def add(self, stamps: Array) -> None:
        """Take the next block, float64 (n,), in seconds."""
        if self._count == 0:
            steps = np.diff(stamps)
            forward = steps[steps > 0]
            self._usual = float(np.median(forward)) if forward.size else 0.0
            self._begin = float(stamps[0])
            self._last = self._begin - self._usual
            mean = float(stamps[-1] - stamps[0]) / max(stamps.size - 1, 1)
            self._grid_step = mean if np.isfinite(mean) else self._usual
        with np.errstate(invalid="ignore"):
            steps = np.diff(stamps, prepend=self._last)
            long = steps > (1.0 + UNEVEN) * self._usual
            back = steps <= 0
            self._missing_s += float(np.sum(steps[long] - self._usual))
            self._longest = max(self._longest, float(np.nanmax(steps, initial=0.0)))
            self._back += int(np.sum(back | ~np.isfinite(steps)))
            bad = np.flatnonzero(long | back | ~np.isfinite(steps))
            sample = np.arange(self._count, self._count + stamps.size, dtype=np.float64)
            off = stamps - (self._begin + self._grid_step * sample)
            starts = np.arange(0, stamps.size, _PART)
            middle = sample[np.minimum(starts + _PART // 2, stamps.size - 1)]
            self._off.append(np.stack([middle, np.fmin.reduceat(off, starts), np.fmax.reduceat(off, starts)]))
        self._faults += bad.size
        for i in bad[: MOST_PLACES - len(self._places)]:
            self._places.append(self._place(int(i), float(steps[i]), float(stamps[i])))
        self._count += stamps.size
        finite = stamps[np.isfinite(stamps)]
        self._last = float(finite[-1]) if finite.size else self._last

    def _place(self, i: int, step: float, at: float) -> str:
        row = self._count + i + self.first_row
        before = at - step
        where = f"{'line' if self.first_row else 'sample'} {row} ({before:.6g} s)"
        if not np.isfinite(step):
            return f"{'line' if self.first_row else 'sample'} {row}: no time"
        if step == 0:
            return f"{where}: stands still"
        return f"{where}: {'jumps by' if step > 0 else 'runs back by'} {abs(step):.4g} s"

    def stamps(self) -> Stamps:
        """Return the summary."""
        span = self._last - self._begin
        gaps_matter = self._longest > LONGEST_GAP * self._usual or self._missing_s > MOST_MISSING * span
        is_usable = self._usual > 0 and not self._back and not (self._missing_s > 0 and gaps_matter)
        mean = span / (self._count - 1) if self._count > 1 and not self._faults else self._usual
        wander = self._wander(mean) if mean > 0 else float("inf")
        return Stamps(mean, 1.0 / mean if mean > 0 else None, tuple(self._places), self._faults, is_usable, wander)

    def _wander(self, step: float) -> float:
        """Return the largest distance of a stamp from a grid of ``step`` behind the first one, in steps."""
        middle, low, high = np.concatenate(self._off, axis=1)
        shift = (step - self._grid_step) * middle
        return float(max(np.nanmax(high - shift, initial=0.0), -np.nanmin(low - shift, initial=0.0))) / step
