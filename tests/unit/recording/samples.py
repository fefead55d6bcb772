"""Small recordings with known contents."""

from __future__ import annotations

from typing import Any

import numpy as np

COLUMNS = [("tick", "1"), ("t", "s"), ("volts_0", "V"), ("command_1", "V"), ("status", "bits")]
METADATA: dict[str, Any] = {"bench": 'name = "µ"\n', "stages": {"gain": 1.5}, "clock": "virtual"}


def make_rows(n: int, seed: int = 3, first: int = 0) -> np.ndarray:
    """Rows with the awkward values that must survive: NaN with a payload, -0.0, infinities, denormals."""
    rng = np.random.default_rng(seed)
    rows = rng.normal(size=(n, len(COLUMNS)))
    rows[:, 0] = np.arange(first, first + n)
    rows[:, 1] = rows[:, 0] * 1e-3
    special = np.array([np.nan, -0.0, np.inf, -np.inf, 5e-324, np.finfo(float).max])
    rows[:: max(1, n // 50), 2] = rng.choice(special, size=len(rows[:: max(1, n // 50)]))
    if n > 3:
        rows.view(np.uint64)[3, 2] = 0x7FF8_0000_DEAD_BEEF
    rows[:, 4] = rng.integers(0, 64, n)
    return rows


def same_bits(a: np.ndarray, b: np.ndarray) -> bool:
    a, b = np.ascontiguousarray(a), np.ascontiguousarray(b)
    return a.shape == b.shape and bool(np.array_equal(a.view(np.uint64), b.view(np.uint64)))
