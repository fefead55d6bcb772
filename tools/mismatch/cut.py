"""One stretch of a recording as a recording of its own: without gaps, on a uniform clock."""

from __future__ import annotations

import json
import os
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from hal.trust import allow_name, path_inside
from tools.errors import InputError
from tools.mismatch.recording import Array
from tools.mismatch.recording_columns import read_columns
from tools.mismatch.recording_load import LONGEST_GAP, MIN_SAMPLES, descriptor, on_grid


@dataclass(frozen=True)
class Stretch:
    """What was kept: ``samples`` on a uniform clock of ``rate_hz``, from ``start_s`` to ``stop_s`` of the original;
    ``filled`` of them stand where the original had none; ``parts``: how many stretches there were.
    """

    samples: int
    rate_hz: float
    start_s: float
    stop_s: float
    filled: int
    parts: int


def cut(path: Path, out: Path, start_s: float | None = None, stop_s: float | None = None) -> Stretch:
    """Write the longest stretch without gaps between two times into the folder ``out``, resampled to uniform steps.

    A gap is more than ``LONGEST_GAP`` usual steps without a sample that is finite in every column; shorter ones are
    filled by straight lines and counted. A time column may be out of order. Raises RecordingError for a descriptor or a
    data file that cannot be read, InputError where too little is left.
    """
    path = path / "recording.toml" if path.is_dir() else path
    text = descriptor(path)
    channels = [c for c in text.get("channels", []) if isinstance(c, dict)]
    names = [str(c["column"]) for c in channels if "column" in c]
    clock = text.get("time_column")
    data = path_inside(path, str(text.get("data")))
    columns = read_columns(data, list(dict.fromkeys([*names, *([clock] if isinstance(clock, str) else [])])))
    n = next(iter(columns.values())).size
    if isinstance(clock, str):
        t = columns[clock]
    elif isinstance(text.get("rate_hz"), int | float) and text["rate_hz"] > 0:
        t = np.arange(n) / float(text["rate_hz"])
    else:
        raise InputError(f"{path}: neither 'rate_hz' nor 'time_column'; give one of them")
    good = np.isfinite(t) & np.all([np.isfinite(columns[c]) for c in names], axis=0)
    good &= (t >= (-np.inf if start_s is None else start_s)) & (t < (np.inf if stop_s is None else stop_s))
    order = np.flatnonzero(good)[np.argsort(t[good], kind="stable")]
    order = order[np.diff(t[order], prepend=-np.inf) > 0]
    if order.size < MIN_SAMPLES:
        raise InputError(f"{data}: {order.size} usable samples between these times; at least {MIN_SAMPLES} are needed")
    steps = np.diff(t[order])
    usual = float(np.median(steps))
    edges = np.r_[0, np.flatnonzero(steps > LONGEST_GAP * usual) + 1, order.size]
    long_s = t[order[edges[1:] - 1]] - t[order[edges[:-1]]]
    first = int(np.argmax(long_s))
    kept = order[edges[first] : edges[first + 1]]
    if kept.size < MIN_SAMPLES:
        raise InputError(f"{data}: the longest stretch has {kept.size} samples; at least {MIN_SAMPLES} are needed")
    stamps = t[kept]
    close = np.diff(stamps) <= 1.5 * usual
    dt = float(np.mean(np.diff(stamps)[close])) if close.any() else usual
    count = max(1, round(float(stamps[-1] - stamps[0]) / dt))
    dt = float(stamps[-1] - stamps[0]) / count
    grid = stamps[0] + dt * np.arange(count + 1)
    written: dict[str, Array] = {c: on_grid(grid, dt, stamps, columns[c][kept]) for c in names}
    nearest = np.abs(stamps[np.clip(np.searchsorted(stamps, grid - 0.5 * dt), 0, stamps.size - 1)] - grid)
    _write(path, text, out, written, 1.0 / dt)
    filled = int(np.sum(nearest > 0.75 * dt))
    return Stretch(count + 1, 1.0 / dt, float(stamps[0]), float(stamps[-1]), filled, edges.size - 1)


def _write(path: Path, text: dict[str, Any], out: Path, columns: dict[str, Array], rate_hz: float) -> None:
    """The descriptor and its data; a split in samples no longer means anything and is left out."""
    out.mkdir(parents=True, exist_ok=True)
    head = {k: v for k, v in text.items() if k not in ("time_column", "split")}
    head |= {"data": "data.npz", "rate_hz": rate_hz}
    twin = head.get("twin")
    if isinstance(twin, dict) and isinstance(twin.get("file"), str):
        file = path_inside(path, twin["file"])
        allow_name(file)  # the new folder names it where it is
        head["twin"] = {"file": os.path.relpath(file, out.resolve())}
    np.savez(out / "data.npz", **columns)  # pyright: ignore[reportArgumentType]
    (out / "recording.toml").write_text(toml_text(head), encoding="utf-8")


def toml_text(table: Mapping[str, Any], name: str = "") -> str:
    """A table as TOML: its plain values, then its tables and lists of tables, each under its own head."""
    plain = {k: v for k, v in table.items() if not isinstance(v, Mapping) and not _of_tables(v)}
    lines = [f"{_key(k)} = {_value(v)}" for k, v in plain.items()]
    for k, v in table.items():
        if k in plain:
            continue
        below = f"{name}.{_key(k)}" if name else _key(k)
        for entry in v if _of_tables(v) else [v]:
            head = f"[[{below}]]" if _of_tables(v) else f"[{below}]"
            lines += ["", head, toml_text(entry, below).rstrip("\n")]
    return "\n".join(lines) + "\n"


def _of_tables(value: object) -> bool:
    return isinstance(value, list) and bool(value) and all(isinstance(v, Mapping) for v in value)


def _key(name: str) -> str:
    return name if re.fullmatch(r"[A-Za-z0-9_-]+", name) else json.dumps(name)


def _value(value: Any) -> str:
    if isinstance(value, bool):
        return "true" if value else "false"
    if isinstance(value, str):
        return json.dumps(value)
    if isinstance(value, Sequence):
        return "[" + ", ".join(_value(v) for v in value) + "]"
    return repr(value)
