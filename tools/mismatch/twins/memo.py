"""Caches what does not change between the simulations of a view."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field

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


@dataclass(frozen=True)
class Start:
    """Holds fitted start states ``x0`` (stretches, s), and how they act on the run from them.

    ``states`` (n, s, s): change of the states by each start state, over its typical size; ``slopes`` (rows, outputs, s)
    the same of what is measured, weighted, on the samples that set the start.
    """

    x0: Array
    states: Array
    slopes: Array


@dataclass(frozen=True, eq=False)
class Nearby:
    """Holds the start of a run at the begin of a search, by its stretches; other runs of the search start near it.

    Their start states are moved along the first run's sensitivities, which costs no further run. A search has its own,
    so that its result does not depend on what the process has run before.
    """

    of_stretches: dict[bytes, Start] = field(default_factory=dict[bytes, Start])
    earlier: dict[bytes, Start] = field(default_factory=dict[bytes, Start])
    """Starts at an earlier place of the search, where the search for those of this place begins."""

    @property
    def nbytes(self) -> int:
        return sum(s.x0.nbytes + s.states.nbytes + s.slopes.nbytes for s in self.of_stretches.values())

    def copy(self) -> Nearby:
        """Return the same starts for another search, which may add its own."""
        return Nearby(dict(self.of_stretches), dict(self.earlier))

    def elsewhere(self) -> Nearby:
        """Return what is known of the starts at another place of the search."""
        return Nearby(earlier={**self.earlier, **self.of_stretches})
