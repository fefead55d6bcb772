"""Records when this host stood still, which distinguishes a silent device from a loop that did not run."""

from __future__ import annotations


class HostGaps:
    """Counts gaps of at least ``limit_ms`` in which the loop was due and did not run. Times are the bench clock's."""

    def __init__(self, limit_ms: float) -> None:
        self.stalls = 0
        self.longest_ms = 0.0
        self._limit_ms = limit_ms
        self._last_ms = 0.0
        self._last_ns: int | None = None

    def record(self, due_ns: int, now_ns: int) -> None:
        """Record that the loop was due at ``due_ns`` and ran at ``now_ns``. An emulated world records gaps likewise."""
        late_ms = (now_ns - due_ns) * 1e-6
        if late_ms < self._limit_ms:
            return
        self.stalls += 1
        self.longest_ms = max(self.longest_ms, late_ms)
        self._last_ms, self._last_ns = late_ms, now_ns

    def recent_ms(self, now_ns: int, within_ms: float) -> float:
        """Return the length of the last gap, ms, if it ended within the last ``within_ms``, else 0."""
        if self._last_ns is None or (now_ns - self._last_ns) * 1e-6 > within_ms:
            return 0.0
        return self._last_ms
