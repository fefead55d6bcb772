"""Holds small functions that several drivers need."""

from __future__ import annotations

from typing import Protocol

from hal.contracts import Clock


class DigitalOutput(Protocol):
    """Defines a few switch outputs that are set at once: bit i is output i."""

    def write_digital(self, bits: int) -> None: ...


def wait_s(clock: Clock, seconds: float) -> None:
    """Let ``seconds`` pass on the bench clock. For start-up only, never in a tick."""
    clock.sleep_until_ns(clock.now_ns() + round(seconds * 1e9))


def next_due_ns(due_ns: int, now_ns: int, period_ns: int) -> int:
    """Return the next due time of a periodic action that was due at ``due_ns`` and is done now.

    The action keeps its phase, unless it is late by a period or more: then it is due one period from now, so that
    missed actions are not made up for in a burst."""
    following_ns = due_ns + period_ns
    return following_ns if following_ns > now_ns else now_ns + period_ns
