"""Turns signals into facts that the loop reads once per pass: an interrupt ends the run, SIGUSR1 ends a hold."""

from __future__ import annotations

import contextlib
import signal
from collections.abc import Generator


class Signals:
    """Keeps the signals that have come. ``interrupted`` is the name of the last SIGINT or SIGTERM, ``interrupts`` their
    number. SIGUSR1 sets ``rearm_asked``; the loop clears it at neutral, where a hold that cannot end yet drops it."""

    def __init__(self) -> None:
        self.interrupted = ""
        self.interrupts = 0
        self.rearm_asked = False

    @contextlib.contextmanager
    def caught(self) -> Generator[None]:
        """Catch the signals within the block. Has no effect outside the main thread, which alone can catch them."""
        handlers = {signal.SIGINT: self._interrupt, signal.SIGTERM: self._interrupt, signal.SIGUSR1: self._rearm}
        try:
            previous = {number: signal.signal(number, handler) for number, handler in handlers.items()}
        except ValueError:  # not the main thread, which alone can handle signals
            previous = {}
        try:
            yield
        finally:
            for number, handler in previous.items():
                signal.signal(number, handler)

    def _interrupt(self, number: int, _frame: object) -> None:
        self.interrupted = signal.Signals(number).name
        self.interrupts += 1

    def _rearm(self, _number: int, _frame: object) -> None:
        self.rearm_asked = True
