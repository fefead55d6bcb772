"""The memory that the compiled thread and Python share: names of its places, and the tuples of arrays."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

if TYPE_CHECKING:
    from firmware_py.control.plausibility import CheckMemory

Words = NDArray[np.int64]

(
    # Python's words to the thread
    ORDER, BEAT_NS, BEAT_LIMIT_NS, FIXED_NS, READS_LEFT, DAQ_FD, OUTPUT_FD, WAKE_FD, PERIOD_NS, DT_NS, STALE_NS,
    STALLED_NS, LATE_LIMIT_NS, STARTED_NS, END_NS, SPIN_NS, VERIFY_DIVIDER, VERIFY_PHASE, VERIFY_PATIENCE,
    VERIFY_END_NS,
    # where the thread is in the stream of scans
    SEQ_OF_TICK0, LAST_K, LAST_DUE_NS, SILENT_AT_NS, SILENT_OF_NS, WAITS_SINCE_NS,
    # the block under way, and how far it got
    BLOCK_N, BLOCK_T0_NS, BLOCK_SEQ, BLOCK_LOST, BLOCK_SHIFTED, VERDICT, DONE_ROW, DONE_STAGE, FOUND,
    # what the thread tells
    GAP_DUE_NS, GAP_NOW_NS, WARNED, PAIR_TOLD, RECEIVED, TICKS, CAUGHT_UP, COMMANDS, SUPERSEDED, CLIPPED, LATE_NS,
    SCANS_LATE_NS, NOTES, ARRIVAL_NS, SPUN_NS, VERIFY_WAITED, BUSY,
    N_WORDS,
) = range(53)  # fmt: skip
"""Places in ``Memory.words``.

``ORDER``: GO or CALLED_BACK; ``BEAT_NS``: when Python was last alive; ``FIXED_NS``: the time in virtual time, else
REAL_TIME; ``READS_LEFT``: reads until the thread comes back by itself, negative for no limit. ``BLOCK_...``: what
``decode`` returned; ``DONE_ROW`` and ``DONE_STAGE``: the first row and stage of it that are not done. ``SILENT_OF_NS``:
the ``LAST_DUE_NS`` for which ``SILENT_AT_NS`` holds: a wait has one limit, however often it is gone on with;
``WAITS_SINCE_NS``: when that wait began. ``BUSY``: scans, of ``CAUGHT_UP``, for which the thread did not wait yet when
they came.
``LATE_NS`` and ``SCANS_LATE_NS``: when a command or scans were late for the first time, 0 for never; ``NOTES``:
warnings so far. ``SPIN_NS``: how long before and after a scan is expected the thread waits awake; ``ARRIVAL_NS``:
running median of the time from a scan's instant to its arrival; ``SPUN_NS``: time that was waited awake.
``VERIFY_DIVIDER`` (0: never) and ``VERIFY_PHASE``: ticks in which the output is read back; it is deferred for
``VERIFY_PATIENCE`` ticks at most when it would end ``VERIFY_END_NS`` or more after its tick was due; ``VERIFY_WAITED``:
ticks for which it has been.
"""

GO, CALLED_BACK = 1, 0
REAL_TIME = -1
NO_END = (1 << 63) - 1

CALLED, SILENT, READ_FAILED, SCANS, STREAM, STUCK, GAP, DEAF, SPENT, REST = range(10)
"""Why the thread has come back.

CALLED: Python wants to decide something. SILENT: no scan for too long. READ_FAILED: the port failed or was closed, and
a read tells more. SCANS: a block that Python must judge, untouched. STREAM: the verdict of ``accept`` is an error.
STUCK: the output's port did not take a command at once. GAP: the host stood still. DEAF: Python has been silent; the
outputs are at neutral. SPENT: as many reads as were asked for. REST: a block of which Python must do the rest, from
``DONE_ROW`` and ``DONE_STAGE`` on."""

SENSE, ESTIMATE, ACTUATE, PUBLISH, VERIFY = range(5)
"""Stages of a tick, which are the tasks that the thread runs."""
STAGES = ("sense", "estimate", "actuate", "publish", "verify")
RUNS, OVERRUNS, SLIPS, PUT_OFF, SKIPPED, BUDGET_NS, DEADLINE_NS = range(7)
"""Rows of ``Timing.tasks``, one column per stage; the first ``N_COUNTERS`` are counted by the thread."""
N_COUNTERS = 5
NOTE_ROOM = 64
LONG_AGO = 1000
"""Ticks after which what was due beside the thread is not made up for."""


class Timing(NamedTuple):
    """Holds the tasks' figures. ``tasks`` (7, 5); ``durations`` and ``lateness``: histograms (5, words) by stage;
    ``ticks``: histograms (2, words) of the duration and lateness of a tick; ``latency`` (words,)."""

    tasks: Words
    durations: tuple[Words, ...]
    lateness: tuple[Words, ...]
    tick_duration: Words
    tick_lateness: Words
    latency: Words


class Sinks(NamedTuple):
    """Holds where frames go: the page's memory and the recorder's ring; (0,) and (0, 0) arrays where there is none.
    ``page_frame`` is the last whole frame, for Python."""

    live_words: Words
    live_rows: NDArray[np.float64]
    ring: Any
    page_frame: NDArray[np.float64]


class Memory(NamedTuple):
    """Holds everything that the thread works on. ``step``: ``Stages.memory``; ``stream`` and ``buffer``: the DAQ's;
    ``rows``: scans of the block; ``check``: that of ``ScanCheck``; ``saved``: room for its state; ``field`` and
    ``fresh``: of ``FieldInput``; ``output``: of the output's driver; ``notes`` (NOTE_ROOM, 2): warning bits that rose,
    and their ticks."""

    words: Words
    step: Any
    stream: Any
    buffer: NDArray[np.uint8]
    rows: NDArray[np.int16]
    check: CheckMemory
    saved: NDArray[np.int64]
    field: NDArray[np.float64]
    fresh: Words
    output: Any
    timing: Timing
    sinks: Sinks
    notes: Words
