"""Measures a recording's sampling clock by known frequencies; time stamps: ``hal.even_samples``."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np


@dataclass(frozen=True)
class ClockEstimate:
    """Rate with the 95 % interval of the median. ``stated_hz`` is wrong if it lies outside the interval."""

    rate_hz: float
    low_hz: float
    high_hz: float
    stated_hz: float
    recordings: int

    @property
    def stated_is_wrong(self) -> bool:
        return not self.low_hz <= self.stated_hz <= self.high_hz

    @property
    def off_percent(self) -> float:
        """Return the excess of the true rate over the stated one, in percent."""
        return 100.0 * (self.rate_hz / self.stated_hz - 1.0)

    def sentence(self) -> str:
        """Describe the clock for people."""
        found = (
            f"sampling rate from {self.recordings} known frequencies: {self.rate_hz:.2f} Hz "
            f"({self.low_hz:.2f} to {self.high_hz:.2f})"
        )
        if self.stated_is_wrong:
            return f"{found}; the stated {self.stated_hz:g} Hz is not the real rate ({self.off_percent:+.2f} %)"
        return f"{found}; agrees with the stated {self.stated_hz:g} Hz"


def rate_from_known(known_hz: Sequence[float], seen_cycles: Sequence[float], stated_hz: float) -> ClockEstimate:
    """The clock's rate from lines of known frequency, each seen at ``seen_cycles`` per sample.

    The median of their ratios, because a drive may be off by itself; interval by the binomial order statistics of the
    median (distribution-free). Raises ValueError for fewer than six recordings: the interval would be all of them.
    """
    ratio = np.sort(np.asarray(known_hz, dtype=np.float64) / np.asarray(seen_cycles, dtype=np.float64))
    n = len(ratio)
    if n < 6:
        raise ValueError(f"{n} known frequencies: at least 6 are needed for an interval of the clock's rate")
    # ranks of the 95 % interval of a median, normal approximation of the binomial (n >= 6)
    reach = int(np.ceil(0.98 * np.sqrt(n)))
    low = max(0, (n - 1) // 2 - reach)
    high = min(n - 1, n // 2 + reach)
    return ClockEstimate(float(np.median(ratio)), float(ratio[low]), float(ratio[high]), stated_hz, n)
