"""Writes netCDF through xarray: one variable per column on the dimension ``t``, CF units, and where the file comes
from.

A run as a dataset: variables (t,) with ``units`` and ``long_name``, the coordinate ``t`` in seconds since the start of
the run, events as the variable ``event_text`` (JSON) on the coordinate ``event_t``, the texts of the recording as
attributes. ``write`` streams the same into a file.
"""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from importlib.metadata import version
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from firmware_py.frame import Clip, FrameStatus
from firmware_py.layouts import layout_of_recording
from firmware_py.recording import format as fmt
from firmware_py.recording.reader import Recording
from hal.jsonable import to_jsonable
from tools.errors import InputError, RecordingError, missing_column
from tools.formats.blocks import batches, event_times_ns
from tools.formats.columns import Array, as_numbers, check_size
from tools.formats.packages import need

if TYPE_CHECKING:
    from xarray import Dataset

EXTRA = "lab"
CONVENTIONS = "CF-1.11"
_NOT_UDUNITS = {"bits": "1", "tick": "count", "ticks": "count"}
"""Units of ours that UDUNITS, which CF refers to, does not know."""
_SECONDS = {"nanoseconds": 1e-9, "microseconds": 1e-6, "milliseconds": 1e-3, "seconds": 1.0, "minutes": 60.0}
_SECONDS |= {"hours": 3600.0, "days": 86400.0}
_SHORT = {"ns": "nanoseconds", "us": "microseconds", "ms": "milliseconds", "s": "seconds", "sec": "seconds"}
_SHORT |= {"min": "minutes", "h": "hours", "hr": "hours", "d": "days"}
_MOST_ACROSS = 64
"""A variable of two dimensions becomes columns ``name_0``, ``name_1``, ... up to so many."""
_BATCH_BLOCKS = 200
_CHUNK_ROWS = 20_000


def dataset(recording: Recording) -> Dataset:
    """Return a recording as an xarray Dataset; all columns are in memory. ``InputError`` without xarray."""
    (xarray,) = need(recording.path, EXTRA, "xarray")
    columns = recording.arrays()
    clock = columns.pop(fmt.TIME_COLUMN, None)
    if clock is None:
        clock = recording.row_numbers() / recording.tick_hz
    times, texts = _events(recording)
    coordinates = {"t": ("t", clock, _time_attributes(recording)), "event_t": ("event", times, {"units": "s"})}
    variables = {name: ("t", values, _attributes(recording, name)) for name, values in columns.items()}
    variables["event_text"] = ("event", np.array(texts, dtype=object), {"long_name": "what happened, JSON"})
    return xarray.Dataset(variables, coordinates, provenance(recording))


def write(recording: Recording, path: Path) -> None:
    """Write what ``dataset`` returns, with a few blocks in memory at a time. ``InputError`` without h5netcdf."""
    h5netcdf, h5py = need(path.name, EXTRA, "h5netcdf", "h5py")
    clock = recording.names.index(fmt.TIME_COLUMN) if fmt.TIME_COLUMN in recording.names else None
    times, texts = _events(recording)
    with h5netcdf.File(path, "w") as file:
        file.dimensions = {"t": recording.n_rows, "event": len(texts)}
        file.attrs.update(provenance(recording))
        chunks = (max(1, min(_CHUNK_ROWS, recording.n_rows)),)
        options: dict[str, Any] = {"chunks": chunks, "compression": "gzip", "compression_opts": 1, "shuffle": True}
        t = file.create_variable("t", ("t",), "f8", **options)
        t.attrs.update(_time_attributes(recording))
        variables: dict[int, Any] = {}
        for i, name in enumerate(recording.names):
            if i != clock:
                variables[i] = file.create_variable(name, ("t",), "f8", **options)
                variables[i].attrs.update(_attributes(recording, name))
        if clock is None:
            t[:] = recording.row_numbers() / recording.tick_hz
        else:
            variables[clock] = t
        for start, rows in batches(recording, _BATCH_BLOCKS):
            for i, variable in variables.items():
                variable[start : start + rows.shape[1]] = rows[i]
        event_t = file.create_variable("event_t", ("event",), "f8")
        event_t.attrs["units"] = "s"
        event = file.create_variable("event_text", ("event",), h5py.string_dtype())
        event.attrs.update({"long_name": "what happened, JSON", "coordinates": "event_t"})
        if texts:
            event_t[:] = times
            event[:] = np.array(texts, dtype=object)


def provenance(recording: Recording) -> dict[str, str]:
    """Return the global attributes: conventions, title, source, history, and every text of the recording."""
    texts = {name: _text(value) for name, value in recording.metadata.items()}
    revision = texts.get("git_revision", "unknown revision")
    return {
        "Conventions": CONVENTIONS,
        "title": recording.path.stem,
        "source": f"recording of a run (clock {texts.get('clock', 'unknown')}), firmware {revision}",
        "history": f"written from {recording.path.name} by micron-bench {version('micron-bench')}",
        **texts,
        **_health(recording),
    }


def _health(recording: Recording) -> dict[str, str]:
    lost = recording.health
    return {"rows_missing": str(lost.missing_rows)} if lost.missing_rows else {}


def _text(value: object) -> str:
    return value if isinstance(value, str) else json.dumps(to_jsonable(value), ensure_ascii=False)


def _events(recording: Recording) -> tuple[Array, list[str]]:
    return np.array(event_times_ns(recording), np.float64) * 1e-9, [_text(event.content) for event in recording.events]


def _time_attributes(recording: Recording) -> dict[str, str]:
    return {"units": "s", "axis": "T", "long_name": "time since the start of the run"}


def _attributes(recording: Recording, name: str) -> dict[str, str]:
    """Return the unit as UDUNITS spells it (``unit_recorded`` where that is another), the meaning, and the bits."""
    unit = recording.unit(name)
    found = {"units": _NOT_UDUNITS.get(unit, unit)}
    if found["units"] != unit:
        found["unit_recorded"] = unit
    column = layout_of_recording(recording.metadata).find_column(name)
    if column is not None and column.unit == unit:
        part = name.removeprefix(column.name).strip("_")
        found["long_name"] = f"{column.what}{f', {part}' if part else ''}"
        flags = {"clip": Clip, "status": FrameStatus}.get(name) if column.unit == "bits" else None
        if flags is not None:
            found["comment"] = "bits: " + ", ".join(f"{flag.value} {flag.name}" for flag in flags if flag.value)
    return found


def names(path: Path) -> list[str]:
    """Return the variables of numbers along the longest dimension, its coordinate first. Raises RecordingError."""
    with _opened(path) as file:
        return list(_columns(file, _longest(file)))


def units(path: Path) -> dict[str, str]:
    """Return the unit of each column that has one; a time since a date is read in seconds. Raises RecordingError."""
    found: dict[str, str] = {}
    with _opened(path) as file:
        for name, (variable, _) in _columns(file, _longest(file)).items():
            unit = variable.attrs.get("unit_recorded", variable.attrs.get("units"))
            if isinstance(unit, str):
                found[name] = "s" if _since(unit) else unit
    return found


def read(path: Path, wanted: list[str]) -> dict[str, Array]:
    """Return the columns, float64 (n,), unpacked as CF says (scale, offset, missing values). Raises RecordingError."""
    with _opened(path) as file:
        found: dict[str, Array] = {}
        for dimension in (_longest(file), *map(str, file.sizes)):
            columns = _columns(file, dimension)
            if set(wanted) <= columns.keys():
                for name in wanted:
                    variable, index = columns[name]
                    check_size(path, variable.sizes[dimension])
                    part = variable if index is None else variable.isel({_across(variable, dimension): index})
                    found[name] = _numbers(path, name, part)
                return found
        have = _columns(file, _longest(file))
        name = next((name for name in wanted if name not in have), wanted[0])
        raise missing_column(path, name, list(have))


def _numbers(path: Path, name: str, variable: Any) -> Array:
    values = variable.values
    factor = _since(str(variable.attrs.get("units", "")))
    if factor is None:
        return as_numbers(path, name, values)
    return as_numbers(path, name, values - values[:1]) * factor if factor != 1.0 else as_numbers(path, name, values)


def _since(unit: str) -> float | None:
    """Return the seconds of one ``units`` of a CF time coordinate (``hours since ...``); None for any other unit."""
    word, _, rest = unit.strip().partition(" ")
    if not rest.startswith("since "):
        return None
    word = _SHORT.get(word, word)
    return _SECONDS.get(word if word.endswith("s") else f"{word}s")


def _longest(file: Any) -> str:
    of_numbers = [v for v in file.variables.values() if _is_numeric(v)]
    sizes = {str(d): n for d, n in file.sizes.items() if any(d in v.dims for v in of_numbers)}
    return max(sizes, key=lambda d: sizes[d]) if sizes else ""


def _is_numeric(variable: Any) -> bool:
    return variable.dtype.kind in "fiub"


def _across(variable: Any, dimension: str) -> str:
    return next(str(d) for d in variable.dims if d != dimension)


def _columns(file: Any, dimension: str) -> Mapping[str, tuple[Any, int | None]]:
    """Return variable and column number (None with one dimension) by the name of each column along ``dimension``."""
    found: dict[str, tuple[Any, int | None]] = {}
    order = sorted(file.variables, key=lambda name: name != dimension)
    for name in order:
        variable = file.variables[name]
        if dimension not in variable.dims or not _is_numeric(variable):
            continue
        if variable.ndim == 1:
            found[str(name)] = (variable, None)
        elif variable.ndim == 2 and variable.sizes[_across(variable, dimension)] <= _MOST_ACROSS:
            for k in range(variable.sizes[_across(variable, dimension)]):
                found[f"{name}_{k}"] = (variable, k)
    return found


@contextmanager
def _opened(path: Path) -> Iterator[Any]:
    with path.open("rb") as f:
        head = f.read(8)
    engine = "scipy" if head.startswith(b"CDF") else "h5netcdf"
    (xarray,) = need(path, EXTRA, "xarray", *(["h5netcdf", "h5py"] if engine == "h5netcdf" else []))[:1]
    try:
        if engine == "h5netcdf":
            _refuse_links(path)
        with xarray.open_dataset(path, engine=engine, decode_times=False, decode_timedelta=False) as file:
            yield file
    except InputError:
        raise
    except Exception as error:  # h5py, scipy and xarray have no error in common
        first = str(error).splitlines()[0] if str(error) else type(error).__name__
        raise RecordingError(f"{path}: not a readable netCDF file ({first}); write it again as netCDF-4") from None


def _refuse_links(path: Path) -> None:
    """Raise RecordingError where a variable is stored in another file: HDF5 would open whatever it names."""
    import h5py

    with h5py.File(path, "r") as file:
        for name in file:
            link = file.get(name, getlink=True)
            target = None if isinstance(link, h5py.ExternalLink | h5py.SoftLink) else file[name]
            if target is None or (isinstance(target, h5py.Dataset) and (target.external or target.is_virtual)):
                raise RecordingError(f"{path}: '{name}' is stored in another file; copy it into this one")
