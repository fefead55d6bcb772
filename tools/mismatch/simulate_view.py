"""Selects the samples of a recording that are compared, and the stretch that must be simulated for them."""

from __future__ import annotations

from dataclasses import dataclass, field, fields
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from sim_devices.physics.effect import Array
from tools.mismatch.recording import Recording
from tools.mismatch.steady import steady_period
from tools.mismatch.twins.base import Run, Twin
from tools.mismatch.twins.memo import Nearby


@dataclass(frozen=True)
class View:
    """Holds the sample ranges of a recording that are compared.

    ``init`` samples at each start (of the recording, or of every range where the twin restarts) may set the state
    and are not scored; ``lead`` samples before a range may help to set it (a guard gap that is never scored).
    ``fit``: ranges of which all samples set the start states of a linear run (none: the first samples do).
    ``afresh``: all samples of every range set its start state; the first ``init`` are still not scored, because
    effects with a memory need them. ``memo`` caches columns that do not change between calls; do not share it between
    processes.
    """

    recording: Recording
    ranges: tuple[tuple[int, int], ...]
    init: int = 0
    lead: int = 0
    fit: tuple[tuple[int, int], ...] = ()
    afresh: bool = False
    memo: dict[object, object] = field(default_factory=dict[object, object], compare=False, repr=False)
    nearby: Nearby | None = field(default=None, compare=False, repr=False)

    def near(self, nearby: Nearby | None = None) -> View:
        """Return this view, its caches shared, for one search: its start states are sought near those of its begin, or
        near those of an earlier one."""
        view = object.__new__(View)
        view.__dict__.update(self.__dict__, nearby=Nearby() if nearby is None else nearby.copy())
        return view

    def __getstate__(self) -> dict[str, object]:
        """Return the fields without the cache, which another process rebuilds."""
        return {f.name: getattr(self, f.name) for f in fields(self) if f.name not in ("memo", "nearby")}

    def __setstate__(self, state: dict[str, object]) -> None:
        self.__dict__.update(state, memo={}, nearby=None)

    @cached_property
    def index(self) -> NDArray[np.int64]:
        """Return the samples of the view, concatenated ranges, (m,)."""
        return np.concatenate([np.arange(a, b) for a, b in self.ranges])

    @cached_property
    def mask(self) -> NDArray[np.bool_]:
        """Return a mask (n,) of the samples of the recording that are in the view."""
        mask = np.zeros(self.recording.n, np.bool_)
        mask[self.index] = True
        return mask

    def take(self, x: Array) -> Array:
        """Return ``x`` (n,) on the view, (m,); contiguous ranges are copied faster than indices."""
        return np.concatenate([x[a:b] for a, b in self.ranges])

    def scored(self, twin: Twin) -> np.ndarray:
        """Return a mask (m,) of the samples that are scored (not used to set a state)."""
        if self.init == 0 and not self.fit:
            return np.ones(sum(b - a for a, b in self.ranges), np.bool_)
        out: list[np.ndarray] = []
        for a, b in self.ranges:
            first = a + self.init if twin.restart else self.init
            if self.fit and (not twin.restart or (a, b) in self.fit):
                first = a  # its start is fitted like any parameter
            at = np.arange(a, b)
            counts = at >= first
            if not self.fit and not self.period:
                for s in self.recording.segments:
                    counts[max(s - a, 0) : max(s + self.init - a, 0)] = False
            out.append(counts)
        return np.concatenate(out)

    def setting(self, twin: Twin) -> NDArray[np.int64] | None:
        """Return the samples that set the start states.

        These are all samples (``afresh``), or for a linear run those of the fit and, where a twin restarts in every
        range, the first ``init`` of the others. None means the first samples after each start.
        """
        if self.afresh:
            return self.index
        if not self.fit:
            return None
        spans = list(self.fit)
        if twin.restart:
            spans += [(a, min(a + self.init, b)) for a, b in self.ranges if (a, b) not in self.fit]
        return np.concatenate([np.arange(a, b) for a, b in sorted(spans)])

    @cached_property
    def period(self) -> int:
        """Return the period, in samples, of all inputs and outputs from the start on; 0 if they do not repeat."""
        rec = self.recording
        return steady_period(rec.inputs, rec.outputs, (0, *rec.segments))

    def measured(self, output: str) -> Array:
        """Return the recorded output on the view, (m,)."""
        return self.take(self.recording.outputs[output])

    @staticmethod
    def whole(recording: Recording, init: int = 0) -> View:
        """Return the view of the whole recording."""
        return View(recording, ((0, recording.n),), init)


def view_run(twin: Twin, view: View) -> Run:
    """Return the run that a view needs: the whole past, since inputs before a block are known and set its memory.

    A twin that restarts does so at every range; others start at sample 0 and run through.
    """
    rec = view.recording
    starts, window = (0,), view.init
    if twin.restart:
        starts = tuple(sorted({0, *rec.segments, *(max(0, a - view.lead) for a, _ in view.ranges)}))
        window += view.lead
    elif rec.segments:
        starts = (0, *rec.segments)
    setting = view.setting(twin)
    period = 0 if twin.restart else view.period
    afresh = tuple(p.start for p in rec.parts) or (0,)
    return Run(
        rec.t, rec.dt, rec.signals, twin.inputs, rec.outputs, starts, window, view.memo, setting, period, afresh,
        nearby=view.nearby,
    )  # fmt: skip
