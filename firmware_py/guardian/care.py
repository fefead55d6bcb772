"""The firmware's care for its guardian: notice that it is gone, start another one while the outputs rest at neutral.

Models: the health pings of F Prime (``Svc::Health``), ArduPilot's refusal to arm without its safety monitors.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, Protocol

from firmware_py.guardian.heart import Heart
from hal.errors import HalError

SILENT_PASSES = 10
"""A guardian that lives but has said nothing new for so many passes (100 Hz) is lost. Passes are counted instead of
time, because a host that stood still has stopped both."""
START_LIMIT_NS = 10_000_000_000
"""A new guardian must be there within this time."""


class Keeper(Protocol):
    """The guardian as the firmware holds it: a process, or a part of virtual time."""

    heart: Heart

    def is_alive(self) -> bool:
        """Return whether the guardian exists and is ready."""
        ...

    def evict(self) -> None:
        """End it now; it commands nothing any more when this returns."""
        ...

    def replace(self) -> None:
        """End it and begin to start another one; returns at once."""
        ...

    def stop(self, hurry: Callable[[], bool] = lambda: False) -> dict[str, Any] | None:
        """Let it go once it has done what is left to do; what it reports. Idempotent. In a ``hurry`` do not wait."""
        ...

    def came_up(self) -> bool:
        """Return whether the new one is ready; raises ``HalError`` when it could not start."""
        ...


class GuardianCare:
    """Looks after the guardian of ``keeper``. ``replaced`` counts the new ones that came up."""

    def __init__(self, keeper: Keeper) -> None:
        self.replaced = 0
        self._keeper = keeper
        self._seen_ns: int = 0
        self._silent = 0
        self._lost = ""
        self._starting_ns: int | None = None
        self._was_watching: bool | None = None

    @property
    def heart(self) -> Heart:
        """The words of the guardian that is there now."""
        return self._keeper.heart

    def look(self) -> str:
        """Return why the guardian counts as lost, or an empty text. Call it at 100 Hz."""
        heart = self._keeper.heart
        if self._starting_ns is not None:
            return self._lost
        if not self._keeper.is_alive():
            self._lost = "its process has ended"
        elif heart.taken_ns or heart.watched_ns != self._seen_ns:  # while it has the outputs it waits for transfers
            self._seen_ns, self._silent, self._lost = heart.watched_ns, 0, ""
        else:
            self._silent += 1
            if self._silent >= SILENT_PASSES:
                self._lost = f"it has not been heard for {10 * SILENT_PASSES} ms"
        return self._lost

    def restore(self, now_ns: int) -> str:
        """Replace a lost guardian, step by step, while the outputs rest at neutral.

        Return what is waited for; empty when a guardian is there. Raises ``HalError`` when none came up.
        """
        if not self._lost and not self._keeper.is_alive():
            self._lost = "its process has ended"
        if not self._lost:
            return ""
        if self._starting_ns is None:
            self._starting_ns = now_ns
            self._keeper.replace()
        elif self._keeper.came_up():
            self.replaced += 1
            self._seen_ns, self._silent, self._lost, self._starting_ns = 0, 0, "", None
            return ""
        elif now_ns - self._starting_ns > START_LIMIT_NS:
            raise start_failed(f"no word from it within {START_LIMIT_NS * 1e-9:g} s")
        return "a new guardian of the outputs"

    def finish(self, hurry: Callable[[], bool]) -> dict[str, Any]:
        """Let the guardian go at the end of a run; unless in a ``hurry``, wait until it has done what is left to do.

        Return what it reports; empty when it leaves no word.
        """
        self._was_watching = self._is_watching()
        return self._keeper.stop(hurry) or {}

    def _is_watching(self) -> bool:
        return not self._lost and self._keeper.is_alive()

    def describe(self) -> dict[str, object]:
        """Return the entry of the guardian in the result of a run, as JSON values."""
        watching = self._is_watching() if self._was_watching is None else self._was_watching
        return {"watching": watching, "replaced": self.replaced}


def start_failed(why: str) -> HalError:
    """The error of a guardian that did not come up."""
    return HalError(f"the guardian of the outputs did not start: {why}")
