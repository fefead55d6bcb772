"""Watches a running instrument in a thread of its own: rows of the frame in, residual and alarms out.

The first part of the run is the reference in which the twin is good; after it the sequential test examines every
block. The tick is independent of it: rows come from shared memory that any number of processes may read.
"""

from __future__ import annotations

import queue
import threading
import time
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np

from firmware_py.frame import STATUS, TIME, FrameStatus
from tools.errors import InputError, RecordingError
from tools.mismatch.recording import Array
from tools.mismatch.watch.detector import Alarm, State, begin, follow, interrupt
from tools.mismatch.watch.frame import LiveTwin
from tools.mismatch.watch.reference import Reference, learn

SHOWN_S = 1.0
"""Time over which the displayed rms is computed."""
MOST_ALARMS = 200
MOST_WAITING = 50
"""Largest number of pieces of rows that wait for the thread; in real time later ones are dropped, which is a gap."""
GAP = 1.5
"""Time between two rows, in time steps, from which rows are missing between them."""


@dataclass(frozen=True)
class Settings:
    """Holds a checked request to watch: the twin's file, the length of the reference, false alarms per hour."""

    twin: Path
    reference_s: float
    false_alarms_per_hour: float


@dataclass(frozen=True)
class Watching:
    """Holds the state of a watch for the page.

    ``phase``: reference, watching or failed (``why``); ``rms`` and ``reference_rms`` by channel, in ``unit``;
    ``alarms``: the first ``MOST_ALARMS``, with times since the start of the run; ``cpu_share``: processor time of the
    thread over the time of the run; ``gaps``: number of places where rows were missing.
    """

    twin: str
    phase: str
    why: str
    reference_s: float
    false_alarms_per_hour: float
    t_s: float
    unit: Mapping[str, str]
    rms: Mapping[str, float]
    reference_rms: Mapping[str, float]
    left_out: Mapping[str, str]
    alarms: tuple[Alarm, ...]
    counts: Mapping[str, int]
    gaps: int
    cpu_share: float

    def to_json(self) -> dict[str, Any]:
        """Return JSON values for the page and for ``micron run --json``."""
        return {"verdict": "leaves" if self.alarms else "stays", **asdict(self)}


class LiveWatch:
    """Watches a run: ``push`` takes rows, ``state`` returns the state, ``close`` ends the thread.

    With ``is_patient``, ``push`` waits for the thread; no time of the bench passes meanwhile.
    """

    def __init__(self, twin: LiveTwin, settings: Settings, *, is_patient: bool) -> None:
        self._twin, self._settings, self._is_patient = twin, settings, is_patient
        self._queue: queue.Queue[Array | None] = queue.Queue(MOST_WAITING)
        self._lock = threading.Lock()
        self._gathered: list[Array] = []
        self._restarts: list[int] = []
        self._reference: Reference | None = None
        self._state: State | None = None
        self._order: list[int] = []
        self._recent: Array = np.zeros((0, len(twin.outputs)))
        self._last_s = float("nan")
        self._first_s = float("nan")
        self._alarms: list[Alarm] = []
        self._counts: dict[str, int] = {}
        self._gaps, self._cpu_s, self._why = 0, 0.0, ""
        self._has_begun = not twin.needs_bench_time
        self._thread = threading.Thread(target=self._work, name="watch", daemon=True)
        self._thread.start()

    def begin_at(self, start_s: float) -> None:
        """Set the time of the bench's clock at the start of the run, before the first ``push``."""
        self._twin.begin_at(start_s)
        self._has_begun = True

    @property
    def has_begun(self) -> bool:
        """Return True once the watch has everything that it needs before rows come."""
        return self._has_begun

    def push(self, rows: Array) -> None:
        """Take rows (n, columns) of the frame, in order."""
        if not len(rows) or not self._thread.is_alive():
            return
        if self._is_patient:
            self._queue.put(rows)
            return
        try:
            self._queue.put_nowait(rows)
        except queue.Full:
            return  # the next rows follow a gap

    def state(self) -> Watching:
        """Return the state after the rows processed so far."""
        with self._lock:
            names, reference = self._twin.outputs, self._reference
            rms = np.sqrt(np.nanmean(self._recent**2, axis=0)) if len(self._recent) else np.full(len(names), np.nan)
            t_s = 0.0 if np.isnan(self._last_s) else self._last_s
            phase = "failed" if self._why else "reference" if reference is None else "watching"
            ran_s = t_s - self._first_s
            return Watching(
                str(self._settings.twin),
                phase,
                self._why,
                self._settings.reference_s,
                self._settings.false_alarms_per_hour,
                t_s,
                {o: self._twin.unit[o] for o in names},
                {o: float(v) for o, v in zip(names, rms, strict=True) if np.isfinite(v)},
                {c.name: c.rms for c in reference.channels} if reference else {},
                dict(reference.left_out) if reference else {},
                tuple(self._alarms),
                dict(self._counts),
                self._gaps,
                self._cpu_s / ran_s if ran_s > 0.0 else 0.0,
            )

    def close(self) -> Watching:
        """Process all pushed rows, end the thread and return the last state."""
        if self._thread.is_alive():
            self._queue.put(None)
            self._thread.join()
        return self.state()

    # -- the thread -----------------------------------------------------------------------------------------

    def _work(self) -> None:
        while (rows := self._queue.get()) is not None:
            try:
                began_s = time.thread_time()
                self._take(rows)
                self._cpu_s += time.thread_time() - began_s
            except (InputError, RecordingError, FloatingPointError, np.linalg.LinAlgError) as error:
                with self._lock:
                    self._why = str(error)
                while self._queue.get() is not None:
                    pass
                return

    def _take(self, rows: Array) -> None:
        t_s = rows[:, TIME]
        if np.isnan(self._last_s):
            self._first_s = float(t_s[0])
            self._last_s = float(t_s[0]) - self._twin.dt
        jumps = np.flatnonzero(np.diff(t_s, prepend=self._last_s) > GAP * self._twin.dt)
        for a, b in zip((0, *jumps.tolist()), (*jumps.tolist(), len(rows)), strict=True):
            if a in jumps:
                self._interrupt()
            if b > a:
                self._piece(t_s[a:b], rows[a:b])

    def _interrupt(self) -> None:
        self._twin.restart()
        self._gaps += 1
        self._restarts.append(sum(len(x) for x in self._gathered))
        if self._state is not None:
            self._state = interrupt(self._state)

    def _piece(self, t_s: Array, rows: Array) -> None:
        away = self._twin.advance(t_s, rows)
        # a repeated scan has no new information
        stale = (rows[:, STATUS].astype(np.int64) & int(FrameStatus.STALE)) != 0
        if stale.any() and len(away) == len(rows):
            away[stale] = np.nan
        keep = round(SHOWN_S / self._twin.dt)
        with self._lock:
            self._last_s = float(t_s[-1])
            if len(away):
                self._recent = np.concatenate([self._recent, away])[-keep:]
        if not len(away):
            return
        if self._reference is None:
            self._gather(away)
        else:
            self._test(away)

    def _gather(self, away: Array) -> None:
        self._gathered.append(away)
        if sum(len(x) for x in self._gathered) * self._twin.dt < self._settings.reference_s:
            return
        table = np.concatenate(self._gathered)
        good = np.asarray(np.isfinite(table).all(axis=1), np.bool_)
        # a lost sample of a reference costs the row, and the whitener restarts behind it
        cuts = {int(np.count_nonzero(good[:i])) for i in (*self._restarts, *np.flatnonzero(~good).tolist())}
        table = table[good]
        restarts = tuple(sorted(c for c in cuts if 0 < c < len(table)))
        columns = {o: np.ascontiguousarray(table[:, i]) for i, o in enumerate(self._twin.outputs)}
        reference = learn(columns, self._twin.dt, self._settings.false_alarms_per_hour, restarts)
        order = [self._twin.outputs.index(c.name) for c in reference.channels]
        with self._lock:
            self._reference, self._order = reference, order
        self._gathered = []
        # the test begins at the next row, without memory
        self._state = begin(reference)

    def _test(self, away: Array) -> None:
        assert self._reference is not None
        assert self._state is not None
        # the test counts its own samples, without gaps and leads
        shift_s = self._last_s - (len(away) - 1 + self._state.samples) * self._twin.dt
        self._state, found = follow(self._reference, self._state, away[:, self._order])
        with self._lock:
            for alarm in found:
                self._counts[alarm.channel] = self._counts.get(alarm.channel, 0) + 1
                if len(self._alarms) < MOST_ALARMS:
                    moved = {"t_s": alarm.t_s + shift_s, "onset_s": alarm.onset_s + shift_s}
                    self._alarms.append(Alarm(**{**asdict(alarm), **moved}))


def lines(watching: Watching) -> list[str]:
    """Return the lines that ``micron run`` prints about the watch, a sentence per line."""
    w = watching
    if w.phase == "failed":
        return [f"watch: nothing is watched: {w.why}"]
    if w.phase == "reference":
        return [f"watch: the run ended within the reference of {w.reference_s:g} s; nothing was tested"]
    out = [
        f"watch: {len(w.reference_rms)} channels of {w.twin} behind {w.reference_s:g} s of reference, at most "
        f"{w.false_alarms_per_hour:g} false alarms per hour; {100 * w.cpu_share:.1f} % of a processor"
    ]
    for name in dict.fromkeys(a.channel for a in w.alarms):
        first = next(a for a in w.alarms if a.channel == name)
        out.append(
            f"  {name}: leaves the twin at about {first.onset_s:.2f} s (alarm {first.t_s:.2f} s): the {first.figure} "
            f"of its residual {'rises' if first.rises else 'falls'}; rms {w.reference_rms[name]:.3g} -> "
            f"{w.rms[name]:.3g} {w.unit[name]}; {w.counts[name]} alarms"
        )
    out += [f"  not watched: {name}: {why}" for name, why in w.left_out.items()]
    if not w.alarms:
        out.append("  reality does not leave the twin")
    return out
