"""When this host stood still: what tells a device that is silent from a loop that did not look."""

from __future__ import annotations


class HostGaps:
    """Gaps of at least ``limit_ms`` in which the loop was due and did not run. Times are the bench clock's."""

    def __init__(self, limit_ms: float) -> None:
        self.stalls = 0
        self.longest_ms = 0.0
        self._limit_ms = limit_ms
        self._last_ms = 0.0
        self._last_ns: int | None = None

    def look(self, due_ns: int, now_ns: int) -> None:
        """The loop was to be awake at ``due_ns`` and is at ``now_ns``; an emulated world may tell of its own gaps."""
        late_ms = (now_ns - due_ns) * 1e-6
        if late_ms < self._limit_ms:
            return
        self.stalls += 1
        self.longest_ms = max(self.longest_ms, late_ms)
        self._last_ms, self._last_ns = late_ms, now_ns

    def recent_ms(self, now_ns: int, within_ms: float) -> float:
        """Length of the last gap if it ended within the last ``within_ms``, else 0."""
        if self._last_ns is None or (now_ns - self._last_ns) * 1e-6 > within_ms:
            return 0.0
        return self._last_ms
