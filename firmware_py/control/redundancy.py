"""Handles a failing accelerometer axis: with six axes it ends the run, with more axes it is left out.

This module joins the detectors of single inputs (``plausibility``) and of contradiction (``parity``) to the stage that
can do without an axis (``sensing/leave_out``).
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from firmware_py.control.parity import Parity, Verdict
from firmware_py.control.plausibility import ScanCheck
from firmware_py.control.stages import Stages
from firmware_py.frame import PARITIES, PARITY, STATUS, FrameStatus
from firmware_py.run.context import Run

UNBELIEVED = FrameStatus.INVALID | FrameStatus.STALE | FrameStatus.ALIGNING


class Redundancy:
    """Decides whether to leave out an axis or to end the run. ``labels`` names the axes. An axis is left out only while
    the outputs may move; in a self-test a failing axis is reported instead."""

    def __init__(self, stages: Stages, check: ScanCheck, run: Run, labels: tuple[str, ...]) -> None:
        self._sensing = stages.sensing
        self._parity_columns = stages.frame[PARITY : PARITY + len(PARITIES)]
        self._check = check
        self._supervisor = run.supervisor
        self._incidents = run.incidents
        self._labels = labels
        self._parity = Parity(self._null()) if self._parities() else None

    @property
    def has_spare_axes(self) -> bool:
        """Return True if the bench has more than six axes."""
        return self._parity is not None

    def _parities(self) -> int:
        return int(self._sensing.params["parities"][0])

    def _null(self) -> NDArray[np.float64]:
        return self._sensing.params["null"][0]

    def impossible(self, channel: int, text: str) -> str:
        """Handle an input that read something impossible. Return ``text``, the reason to trip, or an empty string when
        sensing goes on without the axis."""
        axes = len(self._sensing.config.channels)
        if self._parity is None or channel >= axes or not self._parities() or not self._supervisor.may_move:
            return text
        self._leave_out(channel, text)
        return ""

    def agree(self, frame: NDArray[np.float64]) -> str:
        """Check the parity every tick, after the step. Return an empty string, or the reason why the run must end."""
        parity = self._parity
        if parity is None or not self._parities() or int(frame[STATUS]) & UNBELIEVED:
            return ""
        verdict = parity.step(frame[PARITY : PARITY + len(PARITIES)])
        if verdict is Verdict.AGREED:
            return ""
        if not self._supervisor.may_move:
            return "the accelerometer axes (acc) contradict each other" if verdict is Verdict.UNCLEAR else ""
        if verdict is Verdict.FOUND and self._check.stepped_together:
            return "the accelerometer axes (acc) stepped together, and contradict each other: check their supply"
        if verdict is Verdict.FOUND:
            self._leave_out(parity.axis, f"{self._labels[parity.axis]} contradicts the other axes")
            return ""
        self._incidents.notice("the accelerometer axes contradict each other")
        if verdict is Verdict.UNCLEAR:
            return "the accelerometer axes (acc) contradict each other, and it cannot be told which one is wrong"
        return ""

    def _leave_out(self, axis: int, why: str) -> None:
        parity = self._parity
        assert parity is not None
        louder = self._sensing.leave_out(axis, parity.usual)
        self._check.ignore(axis)
        parity.restart(self._null())
        self._parity_columns[self._parities() :] = 0.0
        text = f"{why}: left out, sensing goes on without it; noise of the tip's acceleration times {louder:.2f}"
        self._incidents.notice(text)
        self._incidents.note({"event": "axis left out", "reason": text})
