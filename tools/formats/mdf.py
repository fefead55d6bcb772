"""Writes ASAM MDF 4 through asammdf: one channel group per time base, the unit of each channel in its unit block."""

from __future__ import annotations

import json
import logging
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np

from firmware_py.recording import format as fmt
from firmware_py.recording.reader import Recording
from hal.jsonable import to_jsonable
from tools.errors import InputError, RecordingError, missing_column
from tools.formats.blocks import batches
from tools.formats.columns import Array, as_numbers, check_size
from tools.formats.packages import need

EXTRA = "lab"
_MAGIC = b"MDF     4."
_UNFINISHED = b"UnFinMF "
_MOST_NUMERIC = 5  # channel data types 0 to 5 are integers and floats, ASAM MDF 4.1
_FIRST_TEXT_CONVERSION = 7  # conversions from here on give texts
_ONE_GROUP = "bring them onto one time base first (in asammdf: Resample)"
_BATCH_BLOCKS = 200


def names(path: Path) -> list[str]:
    """Return the channels of numbers on the time base with the most samples, its clock first. Raises RecordingError."""
    with _opened(path) as file:
        groups = range(len(file.groups))
        bases = {g: _time_base(path, file, g) for g in groups if file.groups[g].channel_group.cycles_nr}
        if not bases:
            return []
        base = max(bases.values(), key=lambda b: b[0])
        found: dict[str, None] = {}
        for g, other in bases.items():
            if other == base:
                found.update(dict.fromkeys(name for name, _ in _numeric(file, g)))
        return list(found)


def units(path: Path) -> dict[str, str]:
    """Return the unit of each channel that has one. Raises RecordingError."""
    with _opened(path) as file:
        return {
            channel.name: channel.unit
            for group in file.groups
            for channel in group.channels
            if isinstance(channel.unit, str) and channel.unit
        }


def read(path: Path, wanted: list[str]) -> dict[str, Array]:
    """Return the channels, float64 (n,), which must share one time base. Raises RecordingError."""
    with _opened(path) as file:
        places: dict[str, list[tuple[int, int]]] = {}
        for name in wanted:
            places[name] = [(g, c) for g, c in file.channels_db.get(name, ()) if file.groups[g].channel_group.cycles_nr]
            if not places[name]:
                raise missing_column(path, name, sorted(file.channels_db))
        bases = {g: _time_base(path, file, g) for places_of in places.values() for g, _ in places_of}
        common = set.intersection(*({bases[g] for g, _ in of} for of in places.values()))
        if not common:
            raise RecordingError(f"{path}: {', '.join(wanted)} do not share one time base; {_ONE_GROUP}")
        base = max(common, key=lambda b: b[0])
        chosen = {name: next(at for at in of if bases[at[0]] == base) for name, of in places.items()}
        # one pass over the file: channel by channel asammdf would unpack every block once per channel
        found: dict[str, Array] = {}
        for raw in (False, True):
            some = {name: at for name, at in chosen.items() if _gives_texts(file, at) is raw}
            signals = file.select([(None, *at) for at in some.values()], raw=raw) if some else []
            found |= {n: as_numbers(path, n, s.samples) for n, s in zip(some, signals, strict=True)}
        return {name: found[name] for name in wanted}


def write(recording: Recording, path: Path) -> None:
    """Write one channel group whose clock is the column ``t`` (without one: row number over ``tick_hz``).

    The texts of the recording are the comment of the file, as JSON; its events are comments of the group. Raises
    ``InputError`` without asammdf.
    """
    mdf, blocks = need(path.name, EXTRA, "asammdf", "asammdf.blocks.v4_constants")
    listed = list(recording.names)
    clock = listed.index(fmt.TIME_COLUMN) if fmt.TIME_COLUMN in listed else None
    numbers = recording.row_numbers() / recording.tick_hz if clock is None else np.zeros(0)
    others = [i for i in range(len(listed)) if i != clock]
    with mdf.MDF(version="4.11") as file:
        for start, rows in batches(recording, _BATCH_BLOCKS):
            t = rows[clock] if clock is not None else numbers[start : start + rows.shape[1]]
            if start:
                file.extend(0, [(t, None), *((np.ascontiguousarray(rows[i]), None) for i in others)])
                continue
            signals = [
                mdf.Signal(np.ascontiguousarray(rows[i]), t, name=listed[i], unit=recording.columns[i].unit)
                for i in others
            ]
            file.append(signals, comment="one row per tick", common_timebase=True)
            file.groups[0].channels[0].name = fmt.TIME_COLUMN
        texts = {name: to_jsonable(value) for name, value in recording.metadata.items()}
        texts["events"] = [event.content for event in recording.events]
        file.header.comment = json.dumps(texts, ensure_ascii=False)
        file.save(path, overwrite=True, compression=blocks.CompressionAlgorithm.TRANSPOSED_DEFLATE)


def _numeric(file: Any, group: int) -> Iterator[tuple[str, Any]]:
    for channel in file.groups[group].channels:
        if channel.data_type <= _MOST_NUMERIC:
            yield channel.name, channel


def _time_base(path: Path, file: Any, group: int) -> tuple[int, bytes]:
    """Return the number of samples and the stamps of a group: equal for groups that were sampled together."""
    check_size(path, file.groups[group].channel_group.cycles_nr)
    stamps = np.ascontiguousarray(file.get_master(group), np.float64)
    return stamps.size, stamps.tobytes()


def _gives_texts(file: Any, place: tuple[int, int]) -> bool:
    """Return True for a channel whose conversion turns numbers into texts; its raw numbers are read."""
    conversion = file.groups[place[0]].channels[place[1]].conversion
    return conversion is not None and conversion.conversion_type >= _FIRST_TEXT_CONVERSION


def _close_halfway(error: Exception) -> None:
    """Close the objects of asammdf that a failed constructor left behind: their destructor would raise again, and
    Python would print that beside our message.
    """
    trace = error.__traceback__
    while trace is not None:
        left: Any = trace.tb_frame.f_locals.get("self")
        if type(left).__module__.startswith("asammdf.") and getattr(left, "_closed", None) is False:
            left._closed = True
            if left._tempfile is not None:
                left._tempfile.close()
        trace = trace.tb_next


@contextmanager
def _opened(path: Path) -> Iterator[Any]:
    with path.open("rb") as f:
        head = f.read(len(_MAGIC))
    if head.startswith(_UNFINISHED):
        raise RecordingError(f"{path}: its recorder did not finish the file; finalise it with the tool that made it")
    if head != _MAGIC:
        raise RecordingError(f"{path}: not an MDF 4 file; export it again as ASAM MDF 4")
    (mdf,) = need(path, EXTRA, "asammdf")
    # it prints what it finds wrong, beside the one message that a person shall get
    logger = logging.getLogger("asammdf")
    was_disabled, logger.disabled = logger.disabled, True
    try:
        with mdf.MDF(path, use_display_names=False) as file:
            yield file
    except InputError:
        raise
    except Exception as error:  # asammdf raises whatever its parser stumbles over
        _close_halfway(error)
        first = str(error).splitlines()[0] if str(error) else type(error).__name__
        raise RecordingError(f"{path}: not a readable MDF file ({first}); export it again as ASAM MDF 4") from None
    finally:
        logger.disabled = was_disabled
