"""Holds as spans of bench time: their edges from every row, their causes from what the firmware says."""

from __future__ import annotations

from collections import deque
from collections.abc import Iterable, Mapping
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from firmware_py.recording.reader import Event

MOST_SPANS = 200
NEAR_S = 2.0
"""An event is stamped with the time of the block before it, and the page hears of a hold up to 0.1 s later."""


@dataclass
class HoldSpan:
    """Holds one hold, from ``from_s`` until ``to_s`` (None while it lasts). ``cause`` is empty until it is known."""

    from_s: float
    to_s: float | None = None
    cause: str = ""


class HoldSpans:
    """Follows rows and keeps the newest ``MOST_SPANS`` holds. A hold ends with the first row that is not held."""

    def __init__(self) -> None:
        self.spans: deque[HoldSpan] = deque(maxlen=MOST_SPANS)
        self._cause = ""
        self._causes: list[tuple[float, str]] = []

    @property
    def current(self) -> HoldSpan | None:
        """The hold that lasts, as far as rows have come."""
        return self.spans[-1] if self.spans and self.spans[-1].to_s is None else None

    def follow(self, t_s: NDArray[np.float64], held: NDArray[np.bool_]) -> None:
        """Take rows: times [n] in s, and whether each is within a hold [n]."""
        was = np.concatenate(([self.current is not None], held[:-1]))
        for at in np.flatnonzero(held != was):
            if held[at]:
                self.spans.append(HoldSpan(float(t_s[at]), None, self._cause))
            else:
                self.spans[-1].to_s = float(t_s[at])
        self._name_by_time()

    def name(self, cause: str) -> None:
        """Take the cause of the hold that lasts, or is about to be seen in the rows; empty: no hold lasts."""
        self._cause = cause
        if cause and self.current is not None:
            self.current.cause = cause

    def name_by_events(self, events: Iterable[Event]) -> None:
        """Take causes from the events of a recording, each for the nearest span without one within ``NEAR_S``."""
        for event in events:
            if event.content.get("event") == "hold begins":
                unnamed = [span for span in self.spans if not span.cause]
                _name_nearest(unnamed, event.time_ns * 1e-9, str(event.content.get("reason", "")))

    def name_by_outcome(self, holds: Iterable[Mapping[str, Any]]) -> None:
        """Take causes from the ``holds`` of a run's outcome, for spans whose cause no status told: a hold that is over
        before its rows are read. Its rows may come afterwards."""
        self._causes = [(float(hold["t_s"]), str(hold["cause"])) for hold in holds]
        self._name_by_time()

    def _name_by_time(self) -> None:
        for t_s, cause in self._causes:
            _name_nearest(self.spans, t_s, cause)

    def as_list(self) -> list[dict[str, Any]]:
        """Return the spans for the page."""
        return [asdict(span) for span in self.spans]


def _name_nearest(spans: Iterable[HoldSpan], t_s: float, cause: str) -> None:
    """Give ``cause`` to the span that began nearest to ``t_s``, within ``NEAR_S``, unless it has one."""
    near = [span for span in spans if abs(span.from_s - t_s) < NEAR_S]
    nearest = min(near, key=lambda span: abs(span.from_s - t_s), default=None)
    if nearest is not None and not nearest.cause:
        nearest.cause = cause[:300]
