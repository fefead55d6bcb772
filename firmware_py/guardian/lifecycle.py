"""Checks that the guardian lives, starts another one while the outputs rest at neutral, and stops it after a run.

Models: the health pings of F Prime (``Svc::Health``), ArduPilot's refusal to arm without its safety monitors.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, Protocol

from firmware_py.guardian.heartbeat import Heartbeat
from hal.errors import HalError

SILENT_PASSES = 10
"""Number of checks (at 100 Hz) without a new sign of life after which a living guardian counts as lost. Checks are
counted instead of time, because a host that stands still stops the firmware and the guardian alike."""
START_LIMIT_NS = 10_000_000_000
"""Time limit for a new guardian to get ready."""


class GuardianHandle(Protocol):
    """Defines the firmware's handle of its guardian: a process, or callbacks of a virtual clock."""

    heartbeat: Heartbeat

    def is_alive(self) -> bool:
        """Return whether the guardian exists and is ready."""
        ...

    def kill(self) -> None:
        """End the guardian now. It sends no command after this returns."""
        ...

    def begin_replacement(self) -> None:
        """End the guardian and begin to start another one. Return at once; ``finish_replacement`` follows."""
        ...

    def stop(self, is_interrupted: Callable[[], bool] = lambda: False) -> dict[str, Any] | None:
        """Let the guardian end once the outputs are at rest, and return its report (``Guardian.report``), ``None``
        without one. Wait for it until ``is_interrupted`` returns True. Idempotent."""
        ...

    def finish_replacement(self) -> bool:
        """Return True once the new guardian is ready. Raises ``HalError`` if it could not start."""
        ...


class GuardianLifecycle:
    """Supervises the guardian of ``handle``. ``replaced`` counts the guardians that replaced a lost one."""

    def __init__(self, handle: GuardianHandle) -> None:
        self.replaced = 0
        self._handle = handle
        self._seen_ns: int = 0
        self._silent = 0
        self._lost = ""
        self._starting_ns: int | None = None
        self._was_watching: bool | None = None

    @property
    def heartbeat(self) -> Heartbeat:
        """Return the words that firmware and guardian share."""
        return self._handle.heartbeat

    def check(self) -> str:
        """Return why the guardian counts as lost, or an empty text. Call it at 100 Hz."""
        heartbeat = self._handle.heartbeat
        if self._starting_ns is not None:
            return self._lost
        if not self._handle.is_alive():
            self._lost = "its process has ended"
        elif (
            heartbeat.taken_ns or heartbeat.guardian_alive_ns != self._seen_ns
        ):  # with the outputs it waits for the bus
            self._seen_ns, self._silent, self._lost = heartbeat.guardian_alive_ns, 0, ""
        else:
            self._silent += 1
            if self._silent >= SILENT_PASSES:
                self._lost = f"it has not been heard for {10 * SILENT_PASSES} ms"
        return self._lost

    def restore(self, now_ns: int) -> str:
        """Replace a lost guardian, one step per call, while the outputs rest at neutral.

        Return what the hold waits for, empty once a guardian watches. Raises ``HalError`` if none could be started.
        """
        if not self._lost and not self._handle.is_alive():
            self._lost = "its process has ended"
        if not self._lost:
            return ""
        if self._starting_ns is None:
            self._starting_ns = now_ns
            self._handle.begin_replacement()
        elif self._handle.finish_replacement():
            self.replaced += 1
            self._seen_ns, self._silent, self._lost, self._starting_ns = 0, 0, "", None
            return ""
        elif now_ns - self._starting_ns > START_LIMIT_NS:
            raise start_error(f"no word from it within {START_LIMIT_NS * 1e-9:g} s")
        return "a new guardian of the outputs"

    def stop(self, is_interrupted: Callable[[], bool]) -> dict[str, Any]:
        """Let the guardian end after a run, and return its report, empty if there is none.

        Wait until it has taken the outputs to neutral, or until ``is_interrupted`` returns True.
        """
        self._was_watching = self._is_watching()
        return self._handle.stop(is_interrupted) or {}

    def _is_watching(self) -> bool:
        return not self._lost and self._handle.is_alive()

    def describe(self) -> dict[str, object]:
        """Return the entry of the guardian in the result of a run, as JSON values."""
        watching = self._is_watching() if self._was_watching is None else self._was_watching
        return {"watching": watching, "replaced": self.replaced}


def start_error(why: str) -> HalError:
    """Return the error of a guardian that did not start."""
    return HalError(f"the guardian of the outputs did not start: {why}")
