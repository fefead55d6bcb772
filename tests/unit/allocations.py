"""How often compiled code has asked for memory."""

from __future__ import annotations

from numba.core.runtime import _nrt_python


def allocations() -> int:
    """Count of numba's own heap since counting was switched on, which the first call does."""
    if not _nrt_python.memsys_stats_enabled():
        _nrt_python.memsys_enable_stats()
    return int(_nrt_python.memsys_get_stats_alloc())
