"""Writes Parquet: one column per signal, its unit in the metadata of the field (key ``unit``)."""

from __future__ import annotations

import json
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from firmware_py.recording.reader import Recording
from hal.jsonable import to_jsonable
from tools.errors import RecordingError, missing_column
from tools.formats.blocks import batches
from tools.formats.columns import Array, as_numbers, check_size
from tools.formats.packages import need

EXTRA = "parquet"
_BATCH_BLOCKS = 200
"""Blocks per row group: a row group of 100 rows would make a large file."""


def names(path: Path) -> list[str]:
    """Return the columns of numbers or times. Raises RecordingError."""
    with _opened(path) as (pa, file):
        return [field.name for field in file.schema_arrow if _is_numeric(pa, field.type)]


def units(path: Path) -> dict[str, str]:
    """Return the unit of each column that has one. Raises RecordingError."""
    found: dict[str, str] = {}
    with _opened(path) as (pa, file):
        for field in file.schema_arrow:
            unit = (field.metadata or {}).get(b"unit")
            if unit is not None:
                found[field.name] = unit.decode("utf-8", "replace")
            elif pa.types.is_timestamp(field.type):
                found[field.name] = "s"
    return found


def read(path: Path, wanted: list[str]) -> dict[str, Array]:
    """Return the columns, float64 (n,); an empty cell is NaN. Raises RecordingError."""
    with _opened(path) as (_, file):
        check_size(path, file.metadata.num_rows)
        have = file.schema_arrow.names
        for name in wanted:
            if name not in have:
                raise missing_column(path, name, have)
        table = file.read(columns=wanted)
        return {name: as_numbers(path, name, table.column(name).to_numpy()) for name in wanted}


def write(recording: Recording, path: Path) -> None:
    """Write every column with its unit; the texts of the recording are metadata of the schema. ``InputError`` without
    pyarrow.
    """
    pa, pq = need(path.name, EXTRA, "pyarrow", "pyarrow.parquet")
    schema = pa.schema(
        [pa.field(name, pa.float64(), metadata={"unit": unit}) for name, unit in recording.columns],
        metadata={name: json.dumps(to_jsonable(value)) for name, value in recording.metadata.items()},
    )
    with pq.ParquetWriter(path, schema, compression="zstd") as writer:
        for _, rows in batches(recording, _BATCH_BLOCKS):
            writer.write_batch(pa.record_batch([pa.array(column) for column in rows], schema=schema))


def _is_numeric(pa: Any, kind: Any) -> bool:
    types = pa.types
    return bool(
        types.is_integer(kind) or types.is_floating(kind) or types.is_boolean(kind)
        or types.is_timestamp(kind) or types.is_duration(kind)
    )  # fmt: skip


@contextmanager
def _opened(path: Path) -> Iterator[tuple[Any, Any]]:
    pa, pq = need(path, EXTRA, "pyarrow", "pyarrow.parquet")
    try:
        with pq.ParquetFile(path) as file:
            yield pa, file
    except (pa.ArrowException, OSError, ValueError) as error:
        if isinstance(error, RecordingError):
            raise
        first = str(error).splitlines()[0] if str(error) else type(error).__name__
        raise RecordingError(f"{path}: not a readable parquet file ({first}); write it again") from None
