"""Cuts a stretch of a recording into a recording of its own: without gaps, on a uniform clock."""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from hal.trust import allow_name, path_inside
from tools.errors import InputError, RecordingError
from tools.mismatch.recording import Array
from tools.mismatch.recording_clock import LONGEST_GAP, in_seconds, on_grid
from tools.mismatch.recording_columns import MAX_SAMPLES, column_units, read_columns
from tools.mismatch.recording_load import MIN_SAMPLES, descriptor, read_clock
from tools.mismatch.recording_ranges import MIN_SPAN, read_begins
from tools.output import folder_atomic
from tools.toml_text import toml_text

DESCRIPTOR, DATA = "recording.toml", "data.npz"
"""Files of the recording that a cut writes."""


@dataclass(frozen=True)
class Stretch:
    """Describes the kept stretch: ``samples`` at ``rate_hz``, from ``start_s`` to ``stop_s`` of the original.

    ``filled`` samples stand where the original had none. The original had ``parts`` stretches, of which ``kept`` were
    kept; ``segments`` are the samples at which the second and later ones begin.
    """

    samples: int
    rate_hz: float
    start_s: float
    stop_s: float
    filled: int
    parts: int
    kept: int = 1
    segments: tuple[int, ...] = ()


def cut(
    path: Path, out: Path, start_s: float | None = None, stop_s: float | None = None, every: bool = False
) -> Stretch:
    """Write the longest stretch without gaps between two times into the folder ``out``, resampled to uniform steps.

    With ``every`` all stretches of at least ``MIN_SPAN`` samples are kept, one behind the other, as segments.

    A gap is more than ``LONGEST_GAP`` usual steps without a sample that is finite in every column; shorter ones are
    filled by straight lines and counted. A time column may be out of order. Raises RecordingError for a descriptor or a
    data file that cannot be read, InputError where too little is left or ``out`` holds the recording.
    """
    path = path / "recording.toml" if path.is_dir() else path
    if out.resolve() == path.resolve().parent:
        raise InputError(f"{out}: holds the recording itself, and a cut would replace its data; name another folder")
    existing = [str(out / name) for name in (DATA, DESCRIPTOR) if (out / name).exists()]
    if existing:
        raise InputError(f"{', '.join(existing)}: is there already; name another folder")
    text = descriptor(path)
    names = _columns(path, text.get("channels"))
    rate_hz, clock = read_clock(str(path), text)
    begins = read_begins(path, text.get("segments"))
    data = path_inside(path, str(text.get("data")))
    columns = read_columns(data, list(dict.fromkeys([*names, *([] if clock is None else [clock])])))
    n = next(iter(columns.values())).size
    if clock is not None:
        t = in_seconds(clock, columns[clock], column_units(data).get(clock, ""))
    else:
        assert rate_hz is not None
        t = np.arange(n) / rate_hz
    written, kept = cut_columns(
        data, t, {c: columns[c] for c in names}, begins, (start_s, stop_s),
        every=every,
    )  # fmt: skip
    _write(path, text, out, written, kept.rate_hz, list(kept.segments))
    return kept


def _columns(path: Path, channels: object) -> list[str]:
    """Return the column of each channel. Raises RecordingError where there is none."""
    if not isinstance(channels, list) or not channels:
        raise RecordingError(f"{path}: [[channels]] must be a list of tables")
    names: list[str] = []
    for i, channel in enumerate(channels):
        name = channel.get("column") if isinstance(channel, dict) else None
        if not isinstance(name, str):
            raise RecordingError(f"{path}: [[channels]] {i + 1}: 'column' is missing or not a text")
        names.append(name)
    return names


def cut_columns(
    data: Path,
    t: Array,
    columns: Mapping[str, Array],
    begins: Sequence[int] = (),
    span_s: tuple[float | None, float | None] = (None, None),
    *,
    every: bool = False,
    rate_hz: float | None = None,
) -> tuple[dict[str, Array], Stretch]:
    """Return the columns on a uniform clock, without gaps: the longest stretch, or every one behind the other.

    ``t``: time stamps in seconds, (n,); ``columns``: (n,) each; ``begins``: samples at which a new run begins. A time
    that jumps back further than a gap begins a new run, too. ``rate_hz``: another rate than the usual one; values are
    then means over the new step, or straight lines where the new step is not longer. ``data`` is for messages.
    Raises InputError where too little is left.
    """
    good = np.isfinite(t) & np.all([np.isfinite(x) for x in columns.values()], axis=0)
    start_s, stop_s = span_s
    good &= (t >= (-np.inf if start_s is None else start_s)) & (t < (np.inf if stop_s is None else stop_s))
    where = np.flatnonzero(good)
    if where.size < MIN_SAMPLES:
        raise InputError(f"{data}: {where.size} usable samples between these times; at least {MIN_SAMPLES} are needed")
    run = np.searchsorted(np.array(begins, np.int64), where, side="right") + np.cumsum(_restarts(t[where]))
    sorted_by_time = np.lexsort((t[where], run))
    order, run = where[sorted_by_time], run[sorted_by_time]
    new_run = np.diff(run, prepend=run[0] - 1) > 0
    distinct = new_run | (np.diff(t[order], prepend=-np.inf) > 0)
    order, run = order[distinct], run[distinct]
    if order.size < MIN_SAMPLES:
        raise InputError(f"{data}: {order.size} usable samples between these times; at least {MIN_SAMPLES} are needed")
    steps = np.diff(t[order])
    inside = np.diff(run) == 0
    usual = float(np.median(steps[inside]))
    edges = np.r_[0, np.flatnonzero((steps > LONGEST_GAP * usual) | ~inside) + 1, order.size]
    long_s = t[order[edges[1:] - 1]] - t[order[edges[:-1]]]
    chosen = [int(np.argmax(long_s))]
    if every:
        least_s = 0.0 if rate_hz is None else (MIN_SPAN - 1) / rate_hz
        wide = np.diff(edges) >= MIN_SPAN
        chosen = [k for k in range(edges.size - 1) if wide[k] and long_s[k] >= least_s] or chosen
    kept = np.concatenate([order[edges[k] : edges[k + 1]] for k in chosen])
    if kept.size < MIN_SAMPLES:
        raise InputError(f"{data}: the longest stretch has {kept.size} samples; at least {MIN_SAMPLES} are needed")
    close = steps[inside & (steps <= 1.5 * usual)]
    dt = 1.0 / rate_hz if rate_hz is not None else float(np.mean(close)) if close.size else usual
    made = float(np.sum(long_s[chosen])) / dt
    if made > MAX_SAMPLES:
        raise InputError(
            f"{data}: {made:.3g} samples at {1 / dt:g} Hz; at most {MAX_SAMPLES} are made: lower --resample"
        )
    parts: list[dict[str, Array]] = []
    filled, sizes = 0, []
    for k in chosen:
        one = order[edges[k] : edges[k + 1]]
        stamps = t[one]
        span = float(stamps[-1] - stamps[0])
        if rate_hz is not None:
            count = int(np.floor(span / dt * (1 + 1e-9)))
            grid = stamps[0] + dt * np.arange(count + 1)
            parts.append({c: resample(grid, dt, stamps, x[one]) for c, x in columns.items()})
        else:
            count = max(1, round(span / dt))
            # one stretch sets its own step; several share one
            dt = span / count if len(chosen) == 1 else dt
            grid = stamps[0] + dt * np.arange(count + 1)
            parts.append({c: on_grid(grid, dt, stamps, x[one]) for c, x in columns.items()})
        nearest = np.abs(stamps[np.clip(np.searchsorted(stamps, grid - 0.5 * usual), 0, stamps.size - 1)] - grid)
        filled += int(np.sum(nearest > 0.75 * max(dt, usual)))
        sizes.append(count + 1)
    if sum(sizes) < MIN_SAMPLES:
        raise InputError(f"{data}: {sum(sizes)} samples at {1 / dt:g} Hz; at least {MIN_SAMPLES} are needed")
    segments = tuple(int(k) for k in np.cumsum(sizes)[:-1])
    return {c: np.concatenate([p[c] for p in parts]) for c in columns}, Stretch(
        sum(sizes), 1.0 / dt, float(t[kept[0]]), float(t[kept[-1]]), filled, edges.size - 1, len(chosen), segments
    )


def _restarts(t: Array) -> Array:
    """Return the mask of samples at which the clock restarts: it jumps back by more than a gap and does not return."""
    steps = np.diff(t, prepend=t[0])
    forward = steps[steps > 0]
    gap = LONGEST_GAP * float(np.median(forward)) if forward.size else np.inf
    later = np.r_[t[1:], t[-1]]
    before = np.r_[t[0], t[:-1]]
    return (steps < -gap) & (later < before)


def resample(grid: Array, dt: float, stamps: Array, x: Array) -> Array:
    """Return the means of ``x`` over the steps ``dt`` around the points of ``grid``, (points,).

    Between samples ``x`` runs straight. Where ``dt`` is hardly longer than the usual step of ``stamps`` (n,), the value
    at the point itself is returned.
    """
    if dt <= 1.25 * float(np.median(np.diff(stamps))):
        return np.interp(grid, stamps, x)
    area = np.r_[0.0, np.cumsum(0.5 * (x[1:] + x[:-1]) * np.diff(stamps))]
    slope = np.diff(x) / np.diff(stamps)
    begin, end = (np.clip(grid + side * dt, stamps[0], stamps[-1]) for side in (-0.5, 0.5))

    def integral(at: Array) -> Array:
        i = np.clip(np.searchsorted(stamps, at, side="right") - 1, 0, stamps.size - 2)
        h = at - stamps[i]
        return area[i] + h * (x[i] + 0.5 * slope[i] * h)

    return (integral(end) - integral(begin)) / (end - begin)


def _write(
    path: Path, text: dict[str, Any], out: Path, columns: dict[str, Array], rate_hz: float, segments: list[int]
) -> None:
    """Write the descriptor and its data, without a split in samples, which is no longer valid."""
    head = {k: v for k, v in text.items() if k not in ("time_column", "split", "segments")}
    head |= {"data": DATA, "rate_hz": rate_hz}
    if segments:
        head["segments"] = segments
    twin = head.get("twin")
    if isinstance(twin, dict) and isinstance(twin.get("file"), str):
        file = path_inside(path, twin["file"])
        allow_name(file)  # the new folder names it where it is
        head["twin"] = {"file": os.path.relpath(file, out.resolve())}
    with folder_atomic(out) as folder:
        np.savez(folder / DATA, **columns)  # pyright: ignore[reportArgumentType]
        (folder / DESCRIPTOR).write_text(toml_text(head), encoding="utf-8")
