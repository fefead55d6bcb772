"""Decides what ends an emulated world: the firmware, or, some time after its death, that nobody uses its buses."""

from __future__ import annotations

import signal

END = signal.SIGUSR1
"""The signal by which the firmware ends its world. SIGINT and SIGTERM, which a terminal, ``timeout`` or systemd send to
all processes of a run, are the firmware's: it needs its devices until the outputs are at neutral."""
LINGER_NS = 1_000_000_000
"""Time for which the world continues after the death of the firmware, and after its last client has gone."""
LONGEST_LINGER_NS = 60_000_000_000
"""A client that does not go away keeps the world for so long at most."""


class Linger:
    """Follows an orphaned world. A guardian whose transfer was not answered in time closes its connection and connects
    again: the moment without a client between the two is not the end."""

    def __init__(self) -> None:
        self._begin_ns: int | None = None
        self._wanted_ns = 0

    def begin(self, now_ns: int) -> None:
        """The firmware has died. Idempotent."""
        if self._begin_ns is None:
            self._begin_ns = self._wanted_ns = now_ns

    def is_over(self, now_ns: int, has_clients: bool) -> bool:
        """Return True if nobody wants the world any more. ``has_clients``: somebody is connected to one of its buses
        that may be a guardian."""
        if self._begin_ns is None:
            return False
        if has_clients:
            self._wanted_ns = now_ns
        return now_ns - self._wanted_ns >= LINGER_NS or now_ns - self._begin_ns >= LONGEST_LINGER_NS
