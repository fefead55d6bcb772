"""A keeper of the guardian on a test stand."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from firmware_py.guardian.heart import Heart
from hal.errors import HalError


class Kept:
    """A keeper that does what the test says."""

    def __init__(self, heart: Heart | None = None) -> None:
        self.heart = Heart() if heart is None else heart
        self.alive, self.started, self.ready = True, 0, False
        self.error: HalError | None = None

    def is_alive(self) -> bool:
        return self.alive

    def evict(self) -> None:
        self.alive = False

    def replace(self) -> None:
        self.evict()
        self.heart.forget_guardian()
        self.started += 1

    def stop(self, hurry: Callable[[], bool] = lambda: False) -> dict[str, Any]:
        self.evict()
        return {"why": "nothing"}

    def came_up(self) -> bool:
        if self.error is not None:
            raise self.error
        self.alive = self.ready
        return self.ready
