"""Requests of the Collect view: recordings on disk, notes, quick look, download, export."""

from __future__ import annotations

import asyncio
import json
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np
from starlette.requests import Request
from starlette.responses import FileResponse
from starlette.routing import BaseRoute, Route

from firmware_py.layouts import layout_of_recording
from firmware_py.recording.errors import RecordingError
from firmware_py.recording.files import is_being_recorded
from firmware_py.recording.format import TIME_COLUMN, load_json
from firmware_py.recording.reader import Recording
from tools.bench.hold_spans import HoldSpans
from tools.bench.jobs import Jobs
from tools.bench.recorder import SUFFIX, check_name, is_own_file
from tools.bench.replay import rate_of
from tools.bench.requests import body, clear, text
from tools.bench.session import Session
from tools.errors import InputError
from tools.formats.export import FORMATS

WHOLE = ("recording", "mismatch")
"""Spans that stay recordings: to take away, and for the Mismatch view beside the others."""
MAX_LISTED = 500
LOOK_PIXELS = 900
LOOK_CHANNELS = 8
MOST_NOTES_BYTES = 1 << 20


def listing(folder: Path, recording: str) -> list[dict[str, Any]]:
    """Return the recordings in ``folder``, newest first. The one that is being written is marked."""
    recordings: list[dict[str, Any]] = []
    files = sorted(
        (p for p in folder.glob(f"*{SUFFIX}") if is_own_file(p)), key=lambda p: p.stat().st_mtime, reverse=True
    )
    for path in files[:MAX_LISTED]:
        sidecar = path.with_suffix(".json")
        table: dict[str, Any] = {}
        if is_own_file(sidecar):
            table = _notes(sidecar)
        status = path.stat()
        recordings.append(
            {
                "name": path.stem,
                "bytes": status.st_size,
                "modified": status.st_mtime,
                "recording": path.stem == recording,
                "notes": table.get("notes", []),
                "seconds": _seconds(table),
                "dropped": table.get("dropped"),
                "problem": table.get("problem", ""),
            }
        )
    return recordings


def _seconds(notes: dict[str, Any]) -> float | None:
    """Return how long a recording is by the notes beside it, ``None`` where they do not say it."""
    ticks = notes.get("ticks")
    return ticks / rate_of(notes.get("rate_hz")) if isinstance(ticks, int) else None


def _notes(sidecar: Path) -> dict[str, Any]:
    """Return the notes beside a recording. A file of unknown origin may hold anything."""
    try:
        if sidecar.stat().st_size > MOST_NOTES_BYTES:
            raise ValueError("too long")
        table = load_json(sidecar.read_bytes())
        if not isinstance(table, dict) or not isinstance(table.get("notes", []), list):
            raise ValueError("not the notes of a recording")
        json.dumps(table, allow_nan=False)  # a NaN would cost the whole list
        return table
    except (ValueError, OSError, RecordingError):
        return {"notes": ["(its notes cannot be read)"]}


@lru_cache(maxsize=2)
def _open(path: Path, _modified: float) -> Recording:
    return Recording(path)


def quick_look(path: Path, channels: list[str]) -> dict[str, Any]:
    """Smallest and largest value per pixel of a few channels over the whole recording, one block at a time."""
    try:
        recording = _open(path, path.stat().st_mtime)
    except OSError as error:
        raise InputError(f"{path.name} cannot be read ({error.strerror})") from error
    if not recording.n_rows or TIME_COLUMN not in recording.names:
        raise InputError(f"{path.name} holds no ticks with a time")
    wanted = [name for name in dict.fromkeys(channels) if name in recording.names][:LOOK_CHANNELS]
    index = [recording.names.index(name) for name in (*wanted, TIME_COLUMN)]
    k = max(1, recording.n_rows // LOOK_PIXELS)
    n_buckets = -(-recording.n_rows // k)
    low = np.full((len(wanted), n_buckets), np.nan, dtype=np.float32)
    high = low.copy()
    t_s = np.zeros(n_buckets)
    row = 0
    holds = HoldSpans()
    layout = layout_of_recording(recording.metadata)
    for block in recording.blocks():
        data = block.data[index]
        n = data.shape[1]
        starts = np.concatenate(([0], np.arange(-row % k or k, n, k)))
        first = row // k
        stop = first + len(starts)
        with np.errstate(over="ignore"):
            values = data[:-1].astype(np.float32)
        low[:, first:stop] = np.fmin(low[:, first:stop], np.fmin.reduceat(values, starts, axis=1))
        high[:, first:stop] = np.fmax(high[:, first:stop], np.fmax.reduceat(values, starts, axis=1))
        is_first = (row + starts) % k == 0
        t_s[first:stop][is_first] = data[-1, starts[is_first]]
        row += n
        holds.follow(block.data[index[-1]], layout.read_holds(recording.names, block.data.T))
    holds.name_by_events(recording.events)
    units = {column.name: column.unit for column in recording.columns}
    return {
        "channels": wanted,
        "units": [units[name] for name in wanted],
        "t": np.nan_to_num(t_s).tolist(),
        "low": np.nan_to_num(low).tolist(),
        "high": np.nan_to_num(high).tolist(),
        "health": recording.health.lines(),
        "holds": holds.as_list(),
        "lost": recording.health.lost,
        "names": list(recording.names),
    }


def _time(table: dict[str, Any], key: str) -> float:
    value = table.get(key)
    if isinstance(value, bool) or not isinstance(value, int | float) or not -1e9 < value < 1e9:
        raise InputError(f"{key} must be a time in seconds")
    return float(value)


class _Collect:
    """Answers the requests of the Recordings view: record, look, export, recover, cut, delete."""

    def __init__(self, session: Session, jobs: Jobs) -> None:
        self._session = session
        self._jobs = jobs
        self._recorder = session.recorder
        self._looking = asyncio.Lock()

    def routes(self) -> list[BaseRoute]:
        """Return the routes of the view."""
        return [
            Route("/api/recordings", clear(self._recordings)),
            Route("/api/recording/start", clear(self._start), methods=["POST"]),
            Route("/api/recording/stop", clear(self._stop), methods=["POST"]),
            Route("/api/recording/note", clear(self._note), methods=["POST"]),
            Route("/api/recordings/{name}/look", clear(self._look)),
            Route("/api/recordings/{name}/file", clear(self._download)),
            Route("/api/recordings/{name}/export", clear(self._export), methods=["POST"]),
            Route("/api/recordings/{name}/recover", clear(self._recover), methods=["POST"]),
            Route("/api/recordings/{name}/span", clear(self._span), methods=["POST"]),
            Route("/api/recordings/{name}/delete", clear(self._delete), methods=["POST"]),
        ]

    def _existing(self, request: Request) -> Path:
        path = self._recorder.path(check_name(request.path_params["name"]))
        if not is_own_file(path):
            raise InputError(f"there is no recording {path.stem!r}")
        return path

    async def _recordings(self, _: Request) -> Any:
        now = self._recorder.name if self._recorder.active else ""
        formats = [[ending, known.readers] for ending, known in FORMATS.items()]
        recordings = await asyncio.to_thread(listing, self._recorder.folder, now)  # reads the notes of up to 500 files
        return {"folder": str(self._recorder.folder), "recordings": recordings, "formats": formats}

    async def _start(self, request: Request) -> Any:
        table = await body(request)
        await self._session.start_recording(text(table, "name", longest=80), text(table, "notes"))
        return {"name": self._recorder.name}

    async def _stop(self, _: Request) -> Any:
        return await self._session.stop_recording()

    async def _note(self, request: Request) -> Any:
        self._recorder.note(text(await body(request), "text"), self._session.bench_time_ns())

    async def _look(self, request: Request) -> Any:
        channels = request.query_params.get("channels", "command_1,command_2,command_3").split(",")
        async with self._looking:  # each may hold a chunk of 64 MiB
            return await asyncio.to_thread(quick_look, self._existing(request), channels)

    async def _download(self, request: Request) -> Any:
        path = self._existing(request)
        return FileResponse(path, filename=path.name)

    async def _export(self, request: Request) -> Any:
        path, kind = self._existing(request), text(await body(request), "format")
        if kind not in FORMATS:
            raise InputError(f"{kind!r} is not a format; there are {', '.join(FORMATS)}")
        folder = self._jobs.new_folder()
        out = folder / f"{path.stem}.{kind}"
        command = ["tools.cli.main", "export", str(path), "--out", str(out)]
        return self._jobs.start("export", f"export {out.name}", [command], folder).as_dict()

    async def _recover(self, request: Request) -> Any:
        """Make a finished recording of what is sound in a torn one, beside it; the original stays."""
        path = self._existing(request)
        if (self._recorder.active and path == self._recorder.path(self._recorder.name)) or is_being_recorded(path):
            raise InputError(f"{path.stem!r} is being recorded; stop it first")
        out = self._recorder.path(check_name(f"{path.stem[:60]} recovered"))
        if out.exists() or out.is_symlink():
            raise InputError(f"there is a recording {out.stem!r} already; delete it first")
        folder = self._jobs.new_folder()
        command = ["tools.cli.main", "recover", str(path), "--out", str(out)]
        self._jobs.start("recover", f"recover {path.stem}", [command], folder)
        return {"recording": out.stem}

    async def _span(self, request: Request) -> Any:
        """Cut a span out: for Mismatch as a recording beside the others, else as a file to take away."""
        path, table = self._existing(request), await body(request)
        kind = text(table, "to")
        from_s, to_s = (_time(table, key) for key in ("from_s", "to_s"))
        if from_s >= to_s:
            raise InputError("the span has no length: mark its start and its end")
        if kind not in (*FORMATS, *WHOLE):
            raise InputError(f"{kind!r} is not a format; there are {', '.join((*FORMATS, *WHOLE))}")
        title = f"{path.stem[:50]} {from_s:.2f}-{to_s:.2f} s"
        folder = self._jobs.new_folder()
        ending = SUFFIX if kind in WHOLE else f".{kind}"
        out = self._recorder.path(title) if kind == "mismatch" else folder / f"{title}{ending}"
        if out.is_symlink():
            raise InputError(f"{out} is a symbolic link; remove it first")
        times = ("--from", f"{from_s!r}", "--to", f"{to_s!r}", "--overwrite")
        raw = ("--raw",) if kind in WHOLE else ()
        command = ["tools.cli.main", "export", str(path), "--out", str(out), *raw, *times]
        self._jobs.start("export", f"span of {path.stem}", [command], folder)
        return {"file": out.name, "recording": out.name if kind == "mismatch" else ""}

    async def _delete(self, request: Request) -> Any:
        path = self._existing(request)
        if self._recorder.active and path == self._recorder.path(self._recorder.name):
            raise InputError("this recording is running; stop it first")
        if is_being_recorded(path):
            raise InputError(f"{path.stem!r} is being recorded by another process; stop it first")
        path.unlink()
        path.with_suffix(".json").unlink(missing_ok=True)
        self._session.note("info", f"deleted {path.stem}")


def collect_routes(session: Session, jobs: Jobs) -> list[BaseRoute]:
    """Return the routes of the Recordings view."""
    return _Collect(session, jobs).routes()
