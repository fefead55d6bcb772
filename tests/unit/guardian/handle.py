"""The firmware's handle of a guardian on a test stand, and its side of the heartbeat."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from firmware_py.guardian.gate import WORDS, announce
from firmware_py.guardian.heartbeat import Heartbeat
from hal.errors import HalError


def begin_command(heartbeat: Heartbeat, codes: tuple[int, int, int], *, repeats: bool = False) -> None:
    """Announce a command as the firmware's gate does."""
    gate = [-1] * WORDS
    for _ in range(1 + repeats):
        announce(heartbeat.words, gate, *codes)


class FakeHandle:
    """A handle that does what the test says."""

    def __init__(self, heartbeat: Heartbeat | None = None) -> None:
        self.heartbeat = Heartbeat() if heartbeat is None else heartbeat
        self.alive, self.started, self.ready = True, 0, False
        self.error: HalError | None = None

    def is_alive(self) -> bool:
        return self.alive

    def kill(self) -> None:
        self.alive = False

    def begin_replacement(self) -> None:
        self.kill()
        self.heartbeat.clear_guardian()
        self.started += 1

    def stop(self, is_interrupted: Callable[[], bool] = lambda: False) -> dict[str, Any]:
        self.kill()
        return {"why": "nothing"}

    def finish_replacement(self) -> bool:
        if self.error is not None:
            raise self.error
        self.alive = self.ready
        return self.ready
