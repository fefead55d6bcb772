"""Says on stderr what the time goes into while kernels are compiled, the first time on a machine."""

# pyright: basic
# numba's events have no types

from __future__ import annotations

import sys
from collections.abc import Callable
from time import monotonic
from typing import Any

from numba.core import event

PATIENCE_S = 2.0
"""A few small kernels pass unsaid."""
REPEAT_S = 10.0


class CompileNotice(event.Listener):
    """Hears when numba begins and ends a kernel, nested as kernels call each other; what it reads from disk is silent.

    Whole lines, because other parts of the program may be drawing on the same terminal.
    """

    def __init__(self, now_s: Callable[[], float] = monotonic) -> None:
        self._now_s = now_s
        self._depth, self._done = 0, 0
        self._spent_s, self._began_s = 0.0, 0.0
        self._next_s = PATIENCE_S

    def listen(self) -> None:
        """Start to listen to numba's compile events; this lasts for the life of the process."""
        event.register("numba:compile", self)

    def on_start(self, event: Any) -> None:
        """Record that numba begins to compile a kernel."""
        if self._depth == 0:
            self._began_s = self._now_s()
        self._depth += 1
        self._tell()

    def on_end(self, event: Any) -> None:
        """Record that numba has compiled a kernel."""
        self._done += 1
        self._tell()
        self._depth -= 1
        if self._depth == 0:
            self._spent_s += self._now_s() - self._began_s

    def _tell(self) -> None:
        spent_s = self._spent_s + self._now_s() - self._began_s
        if spent_s < self._next_s:
            return
        self._next_s = spent_s + REPEAT_S
        sys.stderr.write(f"compiling kernels, once per version on this machine: {self._done} done, {spent_s:.0f} s\n")
        sys.stderr.flush()
