"""Keeps the last minutes of every column, and returns the smallest and largest value per pixel of any part of them.

Rows are numbered from the start of the run. Bucket ``b`` of ``k`` rows holds rows ``b k`` to ``(b + 1) k - 1``: the
grid does not move with the window, so what is drawn does not shimmer, and no row is ever left out.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from firmware_py.frame import Layout
from hal.arrays import Array
from tools.diagnose.extremes import extremes

Float32Array = NDArray[np.float32]

BLOCK = 16
"""Rows of one entry of the coarse level."""


class Buckets(NamedTuple):
    """Holds buckets ``first`` to ``first + n - 1``: the time of their first rows (n,) in s and extremes (channels,
    n)."""

    first: int
    per_bucket: int
    t_s: Array
    low: Float32Array
    high: Float32Array


def rows_per_bucket(rows: float, pixels: int) -> int:
    """The finest grid that gives a window of ``rows`` no more than two buckets a pixel; coarse ones in whole blocks."""
    k = max(1, int(rows // max(1, pixels)))
    return k if k < BLOCK else k // BLOCK * BLOCK


class _Ring:
    """Keeps the newest ``depth`` entries of every column. Their numbers never repeat; the oldest are overwritten."""

    def __init__(self, n_columns: int, depth: int) -> None:
        self.depth = depth
        self.head = 0
        self._data = np.zeros((n_columns, depth), dtype=np.float32)

    def append(self, values: Float32Array) -> None:
        """Append ``values`` (columns, n), n at most ``depth``."""
        n = values.shape[1]
        start = self.head % self.depth
        fits = min(n, self.depth - start)
        self._data[:, start : start + fits] = values[:, :fits]
        self._data[:, : n - fits] = values[:, fits:]
        self.head += n

    @property
    def tail(self) -> int:
        return max(0, self.head - self.depth)

    def take(self, channels: NDArray[np.intp], first: int, stop: int) -> Float32Array:
        """Return entries ``first`` to ``stop - 1`` of ``channels`` as a contiguous array (channels, entries)."""
        a, n = first % self.depth, stop - first
        fits = min(n, self.depth - a)
        part = self._data[channels, a : a + fits]
        return part if fits == n else np.concatenate([part, self._data[channels, : n - fits]], axis=1)


class History:
    """Single rows for ``fine_rows``, extremes of blocks of 16 rows for ``coarse_rows``."""

    def __init__(self, layout: Layout, fine_rows: int = 1 << 17, coarse_rows: int = 600_000) -> None:
        self.layout = layout
        self._time_column = layout.start("t")
        self._fine = _Ring(layout.size, fine_rows)
        self._low = _Ring(layout.size, coarse_rows // BLOCK)
        self._high = _Ring(layout.size, coarse_rows // BLOCK)
        # times need more digits than a float32 has after some hours
        self._fine_t = np.zeros(fine_rows)
        self._coarse_t = np.zeros(coarse_rows // BLOCK)

    @property
    def head(self) -> int:
        """Return the number of rows that were ever added."""
        return self._fine.head

    @property
    def oldest(self) -> int:
        """The oldest row of which anything is known."""
        return min(self._fine.tail, self._low.tail * BLOCK)

    @property
    def latest_t_s(self) -> float:
        """Time of the newest row; 0 before the first."""
        return float(self._fine_t[(self.head - 1) % self._fine.depth]) if self.head else 0.0

    def append(self, rows: Array) -> None:
        """Add ``rows`` (n, columns). More rows than the fine level holds are added in parts."""
        step = self._fine.depth // 2
        for start in range(0, len(rows), step):
            self._append(rows[start : start + step])

    def _append(self, rows: Array) -> None:
        numbers = np.arange(self.head, self.head + len(rows))
        self._fine_t[numbers % self._fine.depth] = rows[:, self._time_column]
        self._fine.append(rows.T.astype(np.float32))
        whole = self._fine.head // BLOCK
        first = self._low.head
        if whole > first:
            block = self._fine.take(np.arange(self.layout.size), first * BLOCK, whole * BLOCK)
            low, high = extremes(block, block, BLOCK)
            starts = np.arange(first, whole)
            self._coarse_t[starts % self._low.depth] = self._fine_t[starts * BLOCK % self._fine.depth]
            self._low.append(low)
            self._high.append(high)

    def newest(self, channels: NDArray[np.intp], seconds: float) -> tuple[Array, Float32Array]:
        """Return times (n,) in s and single rows of ``channels`` (channels, n): those of the last ``seconds``."""
        ring = self._fine
        t_s = self._fine_t[np.arange(ring.tail, ring.head) % ring.depth]
        first = ring.tail + int(np.searchsorted(t_s, self.latest_t_s - seconds))
        return t_s[first - ring.tail :], ring.take(channels, first, ring.head)

    def buckets(self, channels: NDArray[np.intp], k: int, first: int, stop: int | None = None) -> Buckets:
        """Buckets of ``k`` rows from ``first`` up to ``stop`` (excluded) or the newest, which may be incomplete.

        ``k`` comes from ``rows_per_bucket``. What has been overwritten is left out: see ``Buckets.first``.
        """
        coarse = k % BLOCK == 0 and k >= BLOCK
        unit = k // BLOCK if coarse else k
        ring = self._low if coarse else self._fine
        end = ring.head if stop is None else min(ring.head, stop * unit)
        first = max(first, -(-ring.tail // unit))
        begin = min(first * unit, end)
        numbers = np.arange(begin, end, unit)
        if coarse:
            t_s = self._coarse_t[numbers % ring.depth]
            low = self._low.take(channels, begin, end)
            high = self._high.take(channels, begin, end)
        else:
            t_s = self._fine_t[numbers % ring.depth]
            low = high = self._fine.take(channels, begin, end)
        low, high = extremes(low, high, unit)
        return Buckets(first, k, t_s, low, high)
