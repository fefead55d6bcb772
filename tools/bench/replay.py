"""A recording in the place of the live data of one viewer: the same questions, answered up to a place in time.

Rows of a replay are ticks of a grid of time: row ``r`` is ``r / rate_hz`` after the recording's first tick, so that
two runs can be laid over one another. Where the recording has no tick, a row is NaN.
"""

from __future__ import annotations

import asyncio
import contextlib
import json
import math
import shutil
import tempfile
import threading
import time
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from firmware_py.frame import Layout
from firmware_py.layouts import layout_of_recording
from firmware_py.recording.errors import RecordingError
from firmware_py.recording.index import IndexedRecording
from hal.children import child_command, child_environment
from tools.bench.history import BLOCK, Buckets
from tools.bench.overview import EXTREMES, SPANS, entries_of
from tools.errors import InputError

MOST_FINE_ROWS = 1 << 17
SPEEDS = (0.1, 0.25, 0.5, 1.0, 2.0, 5.0, 10.0, 50.0)


class RecordedHistory:
    """Answers ``buckets`` as ``history.History`` does, from a file; ``head`` is the first row that is not shown yet.

    ``layout`` is that of the instrument whose channels the page shows. Raises ``RecordingError`` or ``InputError`` for
    a file that cannot be shown. ``lock`` keeps threads apart.
    """

    def __init__(self, path: Path, layout: Layout) -> None:
        self.lock = threading.Lock()
        self.layout = layout
        self._recording = IndexedRecording(path)
        names, channels = self._recording.names, layout.scalar_names()
        self.missing = [name for name in channels if name not in names]
        made_by = layout_of_recording(self._recording.metadata)
        if made_by is not layout or len(self.missing) > len(channels) - 2:  # t alone is everybody's
            self._recording.close()
            some_names = ", ".join(names[:6])
            raise InputError(
                f"{path.name} is a recording of another instrument: its columns ({some_names} ...) are not the "
                f"channels of the {layout.instrument}. Start the page with a bench of that instrument, or export it "
                "and drop the csv into Mismatch"
            )
        self._column = np.array([names.index(name) if name in names else -1 for name in channels])
        self.rate_hz = rate_of(self._recording.metadata.get("tick_hz"))
        self.start_s = self._recording.start_s
        self.n_rows = round((self._recording.end_s - self.start_s) * self.rate_hz) + 1
        self.n_entries = entries_of(self._recording, self.rate_hz)
        self.head = 0
        self.ready_rows = 0
        self._extremes: NDArray[np.float32] | None = None

    @property
    def length_s(self) -> float:
        return (self.n_rows - 1) / self.rate_hz

    def use_overview(self, file: Path, ready_entries: int) -> None:
        """Take the overview that another process writes, as far as it is ready."""
        if self._extremes is None:
            shape = (2, len(self._recording.columns), self.n_entries)
            self._extremes = np.memmap(file, dtype=np.float32, mode="r", shape=shape)
        self.ready_rows = ready_entries * BLOCK

    def close(self) -> None:
        with self.lock:
            self._extremes = None
            self._recording.close()

    def buckets(self, channels: NDArray[np.intp], k: int, first: int, stop: int | None = None) -> Buckets:
        """Buckets of ``k`` rows from ``first`` up to ``stop`` (excluded) or ``head``, which may be incomplete."""
        with self.lock:
            end = self.head if stop is None else min(self.head, stop * k)
            first = max(0, first)
            begin = min(first * k, end)
            t_s = self.start_s + np.arange(begin, end, k) / self.rate_hz
            if k >= BLOCK and k % BLOCK == 0 and self._extremes is not None and end <= self.ready_rows:
                low, high = self._coarse(channels, begin, end, k)
            elif end - begin <= MOST_FINE_ROWS:
                low, high = self._fine(channels, begin, end, k)
            else:  # the overview is not ready, and so many rows are not read for a picture
                low = high = np.full((len(channels), len(t_s)), np.nan, dtype=np.float32)
        return Buckets(first, k, t_s, low, high)

    def _coarse(
        self, channels: NDArray[np.intp], begin: int, end: int, k: int
    ) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
        assert self._extremes is not None
        a, b = begin // BLOCK, min(-(-end // BLOCK), self.n_entries)
        starts = np.arange(0, b - a, k // BLOCK)
        n = len(range(begin, end, k))
        out = np.full((2, len(channels), n), np.nan, dtype=np.float32)
        for at, column in enumerate(self._column[channels]):
            if column >= 0 and len(starts):
                out[0, at] = np.fmin.reduceat(self._extremes[0, column, a:b], starts)[:n]
                out[1, at] = np.fmax.reduceat(self._extremes[1, column, a:b], starts)[:n]
        return out[0], out[1]

    def _fine(
        self, channels: NDArray[np.intp], begin: int, end: int, k: int
    ) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
        n = len(range(begin, end, k))
        low = np.full((len(channels), n), np.nan, dtype=np.float32)
        high = low.copy()
        if not n:
            return low, high
        half_s = 0.5 / self.rate_hz
        from_s, to_s = self.start_s + begin / self.rate_hz - half_s, self.start_s + end / self.rate_hz - half_s
        columns = self._column[channels]
        for number in self._recording.chunks_between(from_s, to_s):
            rows = self._recording.chunk(number)
            row = np.round((rows.t_s - self.start_s) * self.rate_hz).astype(np.int64)
            inside = np.flatnonzero((row >= begin) & (row < end))
            if not len(inside):
                continue
            bucket = (row[inside] - begin) // k
            starts = np.flatnonzero(np.concatenate(([True], np.diff(bucket) != 0)))
            at = bucket[starts]
            values = np.where((columns >= 0)[:, None], rows.values[np.maximum(columns, 0)][:, inside], np.nan)
            low[:, at] = np.fmin(low[:, at], np.fmin.reduceat(values, starts, axis=1))
            high[:, at] = np.fmax(high[:, at], np.fmax.reduceat(values, starts, axis=1))
        if k == 1:
            _fill_single_gaps(high)
            return high, high
        return low, high


def rate_of(value: Any) -> float:
    """Return the ticks per second that a recording states; 1000 where it states none."""
    try:
        rate_hz = float(value)
    except (TypeError, ValueError):
        return 1000.0
    return rate_hz if 1.0 <= rate_hz <= 1e5 else 1000.0


def _fill_single_gaps(values: NDArray[np.float32]) -> None:
    """Repeat the value before a single missing row: clocks that drift against the grid leave one now and then."""
    gap = np.asarray(np.isnan(values).all(axis=0))
    single = gap[1:-1] & ~gap[:-2] & ~gap[2:]
    at = np.flatnonzero(single) + 1
    values[:, at] = values[:, at - 1]


class Recorded:
    """Holds one opened recording and the process that reads its overview."""

    def __init__(self, path: Path, layout: Layout) -> None:
        self.name = path.stem
        self.path = path
        self.history = RecordedHistory(path, layout)
        self.spans: dict[str, Any] = {"holds": [], "notes": [], "health": [], "lost": False}
        self.error = ""
        self._folder = Path(tempfile.mkdtemp(prefix="micron-overview-"))
        self._process: asyncio.subprocess.Process | None = None
        self._task: asyncio.Task[None] | None = None

    async def start(self) -> None:
        """Begin to read the overview."""
        rate = f"{self.history.rate_hz!r}"
        self._process = await asyncio.create_subprocess_exec(
            *child_command("tools.bench.overview", str(self.path.resolve()), str(self._folder), rate),
            stdin=asyncio.subprocess.DEVNULL,
            stdout=asyncio.subprocess.PIPE,
            stderr=asyncio.subprocess.PIPE,
            env=child_environment(),
        )
        self._task = asyncio.create_task(self._follow(self._process))

    async def _follow(self, process: asyncio.subprocess.Process) -> None:
        assert process.stdout is not None
        assert process.stderr is not None
        stderr = asyncio.create_task(process.stderr.read())
        async for line in process.stdout:
            message = json.loads(line)
            if "ready" in message:
                self.history.use_overview(self._folder / EXTREMES, message["ready"])
            if message.get("done"):
                self.spans = json.loads((self._folder / SPANS).read_text(encoding="utf-8"))
        words = (await stderr).decode(errors="replace").strip()
        if await process.wait() > 0:
            self.error = words.splitlines()[-1] if words else f"{self.name}: its overview could not be read"

    @property
    def progress(self) -> float:
        """Share of the recording whose overview is ready."""
        return min(1.0, self.history.ready_rows / self.history.n_rows)

    async def close(self) -> None:
        if self._process is not None and self._process.returncode is None:
            with contextlib.suppress(ProcessLookupError):
                self._process.kill()
        if self._task is not None:
            await asyncio.gather(self._task, return_exceptions=True)
        self.history.close()
        shutil.rmtree(self._folder, ignore_errors=True)


class Replay:
    """The place in one recording, or in two that are laid over one another, and how fast it moves."""

    def __init__(self, first: Recorded) -> None:
        self.first = first
        self.second: Recorded | None = None
        self.shift_s = 0.0
        self.playing = False
        self.speed = 1.0
        self.generation = 0
        """Grows with every jump and every change of the data: what a viewer was sent before is of another place."""
        self._position_s = 0.0
        self._moved_s = time.monotonic()
        self._was_ready = False
        self.seek(min(first.history.length_s, 10.0))

    @property
    def position_s(self) -> float:
        return self._position_s

    def seek(self, position_s: float) -> None:
        """Go to ``position_s`` from the first tick on, at most to the end."""
        self._place(position_s)
        self.generation += 1

    def _place(self, position_s: float) -> None:
        self._position_s = min(max(0.0, position_s), self.first.history.length_s)
        self._moved_s = time.monotonic()
        for recorded, shift_s in ((self.first, 0.0), (self.second, self.shift_s)):
            if recorded is not None:
                history = recorded.history
                row = math.floor((self._position_s + shift_s) * history.rate_hz) + 1
                history.head = min(max(0, row), history.n_rows)

    def advance(self) -> None:
        """Move on with the clock; stop at the end."""
        ready = all(r.progress >= 1.0 for r in (self.first, self.second) if r is not None)
        if ready and not self._was_ready:
            self.generation += 1
        self._was_ready = ready
        now_s = time.monotonic()
        if self.playing:
            self._place(self._position_s + (now_s - self._moved_s) * self.speed)
            self.playing = self._position_s < self.first.history.length_s
        self._moved_s = now_s

    def play(self, on: bool) -> None:
        """Play or pause; at the end it begins again."""
        if on and self._position_s >= self.first.history.length_s:
            self.seek(0.0)
        self.playing = on
        self._moved_s = time.monotonic()

    async def lay_over(self, second: Recorded | None, shift_s: float = 0.0) -> None:
        """Show ``second`` beside the first, ``shift_s`` later in it; None takes it away."""
        old, self.second, self.shift_s, self._was_ready = self.second, second, shift_s, False
        self.seek(self._position_s)
        if old is not None and old is not second:
            await old.close()

    def as_dict(self) -> dict[str, Any]:
        """Return the JSON values that the page shows."""
        first, second = self.first, self.second
        return {
            "type": "replay",
            "name": first.name,
            "rate_hz": first.history.rate_hz,
            "start_s": first.history.start_s,
            "length_s": first.history.length_s,
            "progress": first.progress,
            "missing": first.history.missing,
            **first.spans,
            "error": first.error or (second.error if second else ""),
            "second": second.name if second else "",
            "shift_s": self.shift_s,
            "second_start_s": second.history.start_s if second else 0.0,
            "second_length_s": second.history.length_s if second else 0.0,
        }

    def place(self) -> dict[str, Any]:
        """Return where it is, which is told more often than the rest."""
        return {"type": "place", "position_s": self._position_s, "playing": self.playing, "speed": self.speed}

    async def close(self) -> None:
        await self.first.close()
        if self.second is not None:
            await self.second.close()


async def open_recorded(path: Path, layout: Layout) -> Recorded:
    """Open ``path`` beside the loop. ``RecordingError`` or ``InputError`` when it cannot be shown."""
    try:
        recorded = await asyncio.to_thread(Recorded, path, layout)
    except OSError as error:
        raise RecordingError(f"{path}: cannot be read ({error.strerror})") from error
    await recorded.start()
    return recorded
