"""Caches what does not change between the simulations of a view."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from sim_devices.physics.effect import Array

MEMO_BYTES = 1 << 28  # largest cache of unchanged columns of a view


def remember(memo: dict[object, object], key: object, make: Callable[[], Array]) -> Array:
    """Return the result of ``make()``, computed once per key; the cache is cleared when it is full."""
    found = memo.get(key)
    if isinstance(found, np.ndarray):
        return found
    value = make()
    if value.nbytes <= MEMO_BYTES // 2:
        stored(memo, key, value, value.nbytes)
    return value


def stored(memo: dict[object, object], key: object, value: object, size: int) -> None:
    """Put a value of ``size`` bytes into a cache, which is cleared when it is full."""
    full = memo.get("bytes", 0)
    assert isinstance(full, int)
    if full + size > MEMO_BYTES:
        memo.clear()
        full = 0
    memo[key] = value
    memo["bytes"] = full + size
