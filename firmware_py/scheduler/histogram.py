"""Provides a log2 histogram of durations that uses integer operations only and allocates nothing after construction."""

from __future__ import annotations

import math
from array import array
from collections.abc import Iterable
from dataclasses import dataclass
from typing import Any

import numpy as np

_SUB_BITS = 4  # 16 linear buckets per octave: half a bucket is at most 1/32 = 3.1 % of the value
_SUB = 1 << _SUB_BITS
_LAST_NS = (1 << 36) - 1  # 68 s; the 32 octaves above 16 ns
_N_BUCKETS = (_LAST_NS.bit_length() - _SUB_BITS) * _SUB + _SUB


def bucket_of(value_ns: int) -> int:
    """Return the index of the bucket that counts ``value_ns`` (0 .. 68 s; larger values share the last bucket)."""
    if value_ns > _LAST_NS:
        return _N_BUCKETS - 1
    octave = value_ns.bit_length() - _SUB_BITS - 1
    return (octave << _SUB_BITS) + (value_ns >> octave) if octave > 0 else value_ns


def bucket_bounds_ns(index: int) -> tuple[int, int]:
    """Return the smallest value and the width of bucket ``index``, in ns."""
    if index < 2 * _SUB:
        return index, 1
    octave = (index >> _SUB_BITS) - 1
    return (_SUB + (index & (_SUB - 1))) << octave, 1 << octave


@dataclass(frozen=True, slots=True)
class Distribution:
    """Holds a histogram's statistics, in us. Quantiles are accurate to 3.2 %; mean, smallest and largest are exact.

    ``max_tick`` is the tick of the largest value. All zero (and ``max_tick`` -1) when ``n`` is 0.
    """

    n: int
    min_us: float
    mean_us: float
    p50_us: float
    p99_us: float
    p99_9_us: float
    max_us: float
    max_tick: int

    def as_dict(self) -> dict[str, float]:
        """Return the statistics in the form of the ``micron run`` JSON."""
        return {
            "n": self.n,
            "p50": self.p50_us,
            "p99": self.p99_us,
            "p99_9": self.p99_9_us,
            "max": self.max_us,
        }


_MIN, _MAX, _TOTAL, _MAX_TICK, _FIRST = range(5)
"""Places in a histogram's words: ns, ns, ns, a tick, and the first bucket."""
_NO_MIN = (1 << 63) - 1


def add_duration(words: Any, value_ns: int, tick: int) -> None:
    """Count ``value_ns``, seen at ``tick``, in the ``words`` of a ``DurationHistogram``. A compiled loop runs the same
    function."""
    if value_ns < 16:  # below one octave a bucket is one nanosecond
        value_ns = max(value_ns, 0)
        index = value_ns
    elif value_ns <= _LAST_NS:
        octave = math.frexp(value_ns)[1] - 5
        index = (octave << 4) + (value_ns >> octave)
    else:
        index = _N_BUCKETS - 1
    words[_FIRST + index] += 1
    words[_TOTAL] += value_ns
    if value_ns > words[_MAX]:
        words[_MAX] = value_ns
        words[_MAX_TICK] = tick
    if value_ns < words[_MIN]:
        words[_MIN] = value_ns


class DurationHistogram:
    """Counts durations in ns. A negative one (a due time in the future) counts as zero.

    ``words``: its whole state, on which ``add_duration`` works.
    """

    __slots__ = ("words",)
    STATE_WORDS = _N_BUCKETS + _FIRST

    def __init__(self) -> None:
        self.words = array("q", bytes(8 * self.STATE_WORDS))
        self.clear()

    def clear(self) -> None:
        """Forget everything."""
        words = self.words
        for i in range(self.STATE_WORDS):
            words[i] = 0
        words[_MIN], words[_MAX], words[_MAX_TICK] = _NO_MIN, -1, -1

    @property
    def n(self) -> int:
        """Return the number of counted values."""
        return sum(self.words[_FIRST:])

    @property
    def max_ns(self) -> int:
        """Return the largest value, 0 when nothing was counted."""
        return max(0, self.words[_MAX])

    @property
    def max_tick(self) -> int:
        """Return the tick of the largest value, -1 when nothing was counted."""
        return self.words[_MAX_TICK]

    def add(self, value_ns: int, tick: int) -> None:
        """Count one value, seen at ``tick``."""
        add_duration(self.words, value_ns, tick)

    def add_all(self, values_ns: Iterable[int]) -> None:
        """Count values, seen at the ticks from ``n`` on."""
        for k, value_ns in enumerate(values_ns, self.n):
            add_duration(self.words, value_ns, k)

    def add_histogram(self, other: DurationHistogram) -> None:
        """Count what ``other`` has counted; its ticks come after those of this one."""
        own_words, other_words, before = self.words, other.words, self.n
        if other_words[_MAX] > own_words[_MAX]:
            own_words[_MAX], own_words[_MAX_TICK] = other_words[_MAX], before + other_words[_MAX_TICK]
        own_words[_MIN] = min(own_words[_MIN], other_words[_MIN])
        own_words[_TOTAL] += other_words[_TOTAL]
        for i in range(_FIRST, self.STATE_WORDS):
            own_words[i] += other_words[i]

    def count_beyond(self, limit_ns: int) -> int:
        """Return the number of values above ``limit_ns``. Those in the limit's own bucket, 6 % wide, are left out."""
        return int(self.counts()[bucket_of(limit_ns) + 1 :].sum())

    def counts(self) -> np.ndarray:
        """Return a copy of the bucket counts, int64."""
        return np.frombuffer(self.words, dtype=np.int64)[_FIRST:].copy()

    def copy_state_to(self, words: np.ndarray) -> None:
        """Copy the whole state into int64 ``words[STATE_WORDS]``, for another process to read."""
        words[:] = self.words

    @classmethod
    def from_state(cls, words: np.ndarray) -> DurationHistogram:
        """Return the histogram that ``copy_state_to`` wrote. Memory of zeros, which nobody has written yet, is an empty
        one."""
        histogram = cls()
        if words[_FIRST:].any():
            histogram.words[:] = array("q", words.tobytes())
        return histogram

    def quantile_ns(self, q: float) -> float:
        """Return the value below which a share ``q`` of the counted values lies, 0 when nothing was counted."""
        cumulated = np.cumsum(self.counts())
        if not cumulated[-1]:
            return 0.0
        rank = max(1, int(np.ceil(q * int(cumulated[-1]))))
        index = int(np.searchsorted(cumulated, rank))
        below = int(cumulated[index - 1]) if index else 0
        lo_ns, width_ns = bucket_bounds_ns(index)
        share = (rank - below - 0.5) / (int(cumulated[index]) - below)
        value_ns = lo_ns + share * (width_ns - 1)
        return min(max(value_ns, float(self.words[_MIN])), float(self.words[_MAX]))

    def distribution(self) -> Distribution:
        """Return percentiles and extremes; the histogram does not change."""
        n = int(self.counts().sum())
        if n == 0:
            return Distribution(0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, -1)
        p50, p99, p99_9 = (self.quantile_ns(q) * 1e-3 for q in (0.5, 0.99, 0.999))
        return Distribution(
            n=n,
            min_us=self.words[_MIN] * 1e-3,
            mean_us=self.words[_TOTAL] / n * 1e-3,
            p50_us=p50,
            p99_us=p99,
            p99_9_us=p99_9,
            max_us=self.words[_MAX] * 1e-3,
            max_tick=self.words[_MAX_TICK],
        )
