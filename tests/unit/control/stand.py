"""A run on a test stand: a virtual clock, an output that is at neutral at once, and what the run says."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from firmware_py.run.context import Run
from firmware_py.run.safety import SafetyLimits, State
from hal.clock import VirtualClock
from hal.types import OutputLimit

MS = 1_000_000


class Events:
    """A recorder that keeps what it is told."""

    def __init__(self) -> None:
        self.events: list[dict[str, object]] = []

    def push(self, row: NDArray[np.float64]) -> bool:
        return True

    def event(self, event: dict[str, object]) -> bool:
        self.events.append(event)
        return True


class StandOutput:
    """``AnalogOutput`` that does what it is told, at once."""

    def __init__(self) -> None:
        self.name = "piezo"
        self.limits: tuple[OutputLimit, ...] = ()
        self.commands_sent = 0
        self.commanded_V: Sequence[float] = (50.0, 50.0, 50.0)

    def arm(self) -> None:
        pass

    def write(self, values_V: NDArray[np.float64]) -> int:
        self.commands_sent += 1
        self.commanded_V = values_V.tolist()
        return 0

    def safe_step(self) -> bool:
        return True

    def readback_V(self) -> NDArray[np.float64]:
        return np.array(self.commanded_V)

    def close(self) -> None:
        pass


class StandRun(Run):
    """A run that has come to ``state``. ``clock`` and ``recorder`` are the stand's own."""

    clock: VirtualClock  # pyright: ignore[reportIncompatibleVariableOverride]
    recorder: Events  # pyright: ignore[reportIncompatibleVariableOverride]

    def __init__(self, state: State = State.RUNNING, limits: SafetyLimits | None = None, **more: Any) -> None:
        clock = more.pop("clock", None) or VirtualClock()
        super().__init__(clock, MS, StandOutput(), limits or SafetyLimits(), recorder=Events(), **more)
        self.supervisor.state = state

    @property
    def reason(self) -> str:
        """The reason of the trip, else of the last hold, else nothing."""
        cause = self.supervisor.trip_cause
        if cause is None and self.supervisor.holds:
            return self.supervisor.holds[-1].reason
        return "" if cause is None else cause.reason
