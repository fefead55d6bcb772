"""Holds as spans of bench time: their edges from the status of every row, their causes from what the firmware says."""

from __future__ import annotations

from collections import deque
from collections.abc import Iterable
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from firmware_py.frame import FrameStatus
from firmware_py.recording.reader import Event

MOST_SPANS = 200
NEAR_S = 2.0
"""An event is stamped with the time of the block before it, and the page hears of a hold up to 0.1 s later."""


@dataclass
class HoldSpan:
    """One hold, from ``from_s`` until ``to_s`` (None: it lasts). ``cause`` is empty until somebody has said it."""

    from_s: float
    to_s: float | None = None
    cause: str = ""


class HoldSpans:
    """Follows rows and keeps the newest ``MOST_SPANS`` holds. A hold ends with the first row that is not held."""

    def __init__(self) -> None:
        self.spans: deque[HoldSpan] = deque(maxlen=MOST_SPANS)
        self._cause = ""

    @property
    def current(self) -> HoldSpan | None:
        """The hold that lasts, as far as rows have come."""
        return self.spans[-1] if self.spans and self.spans[-1].to_s is None else None

    def follow(self, t_s: NDArray[np.float64], status: NDArray[np.float64]) -> None:
        """Take rows: times [n] in s and status words [n]; NaN is no status."""
        words = np.where(np.isfinite(status), status, 0.0).astype(np.int64)
        held = (words & int(FrameStatus.HELD)) != 0
        was = np.concatenate(([self.current is not None], held[:-1]))
        for at in np.flatnonzero(held != was):
            if held[at]:
                self.spans.append(HoldSpan(float(t_s[at]), None, self._cause))
            else:
                self.spans[-1].to_s = float(t_s[at])

    def name(self, cause: str) -> None:
        """Take the cause of the hold that lasts, or is about to be seen in the rows; empty: no hold lasts."""
        self._cause = cause
        if cause and self.current is not None:
            self.current.cause = cause

    def name_by_events(self, events: Iterable[Event]) -> None:
        """Take causes from the events of a recording, each for the nearest span without one within ``NEAR_S``."""
        for event in events:
            content = event.content
            if content.get("event") != "hold begins":
                continue
            t_s = event.time_ns * 1e-9
            near = [s for s in self.spans if not s.cause and abs(s.from_s - t_s) < NEAR_S]
            if near:
                min(near, key=lambda s: abs(s.from_s - t_s)).cause = str(content.get("reason", ""))[:300]

    def as_list(self) -> list[dict[str, Any]]:
        """Return the spans for the page."""
        return [asdict(span) for span in self.spans]
