"""Says on stderr what the time goes into while kernels are compiled, the first time on a machine."""

# pyright: basic
# numba's events have no types

from __future__ import annotations

import sys
import threading
from collections.abc import Callable
from time import monotonic
from typing import Any

from numba.core import event

PATIENCE_S = 2.0
"""A few small kernels pass unsaid."""
REPEAT_S = 10.0


class CompileNotice(event.Listener):
    """Hears when numba begins and ends a kernel, nested as kernels call each other; what it reads from disk is silent.

    While numba compiles, a timer looks at the clock every ``every_s`` seconds: one large kernel takes minutes on a
    loaded machine and raises no event meanwhile. Whole lines, because other parts of the program may be drawing on the
    same terminal.
    """

    def __init__(self, now_s: Callable[[], float] = monotonic, every_s: float = PATIENCE_S) -> None:
        self._now_s, self._every_s = now_s, every_s
        self._depth, self._done = 0, 0
        self._spent_s, self._began_s = 0.0, 0.0
        self._next_s = PATIENCE_S
        self._timer: threading.Timer | None = None
        self._lock = threading.Lock()

    def listen(self) -> None:
        """Start to listen to numba's compile events; this lasts for the life of the process."""
        event.register("numba:compile", self)

    def on_start(self, event: Any) -> None:
        """Record that numba begins to compile a kernel."""
        with self._lock:
            if self._depth == 0:
                self._began_s = self._now_s()
            self._depth += 1
            self._tell()
            if self._timer is None:
                self._wait()

    def on_end(self, event: Any) -> None:
        """Record that numba has compiled a kernel."""
        with self._lock:
            self._done += 1
            self._tell()
            self._depth -= 1
            if self._depth == 0:
                self._spent_s += self._now_s() - self._began_s
                if self._timer is not None:
                    self._timer.cancel()
                self._timer = None

    def _wait(self) -> None:
        """Start the timer that looks at the clock while numba raises no event."""
        self._timer = threading.Timer(self._every_s, self._look)
        self._timer.daemon = True
        self._timer.start()

    def _look(self) -> None:
        """Tell how far it is, in the timer's thread, and start the timer again unless the kernel ended meanwhile."""
        with self._lock:
            if self._timer is threading.current_thread():
                self._tell()
                self._wait()

    def _tell(self) -> None:
        spent_s = self._spent_s + self._now_s() - self._began_s
        if spent_s < self._next_s:
            return
        self._next_s = spent_s + REPEAT_S
        sys.stderr.write(f"compiling kernels, once per version on this machine: {self._done} done, {spent_s:.0f} s\n")
        sys.stderr.flush()
