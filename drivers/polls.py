"""Describes polls in whole ticks, which ``drivers.polling`` computes and drivers and tasks receive."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class Polls:
    """Describes ``count`` polls, evenly spread, in every frame of ``divider`` ticks."""

    divider: int
    count: int = 1

    def per_s(self, tick_hz: float) -> float:
        """Return the number of polls per second."""
        return tick_hz * self.count / self.divider

    def ticks(self, first: int) -> tuple[int, ...]:
        """Return the ticks of a frame in which a poll is due if the first poll is due in tick ``first``."""
        return tuple((first + k * self.divider // self.count) % self.divider for k in range(self.count))

    @property
    def shortest_gap(self) -> int:
        """Return the smallest number of ticks between two polls."""
        return self.divider // self.count


@dataclass(frozen=True)
class Polling:
    """Holds the polling rate of each task of the instrument; ``None`` if this bench has no device for the task."""

    magnetometer: Polls | None = None
    monitor: Polls | None = None
    verify: Polls | None = None
    telemetry: Polls | None = None
