"""Exports recordings for other programs, in the format that the ending of a name asks for, and as the recording folder
of the mismatch contract.

Everything streams block by block; a failed export leaves nothing behind.
"""

from __future__ import annotations

import shutil
import zipfile
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from types import MappingProxyType

import numpy as np
from numpy.lib import format as npy

from firmware_py.recording import format as fmt
from firmware_py.recording.errors import RecordingError
from firmware_py.recording.files import new_file, new_folder, refuse_existing
from firmware_py.recording.reader import Recording
from tools.formats import mdf, netcdf, parquet, view
from tools.toml_text import toml_text

LAYOUTS = Path(__file__).with_name("layouts")
_ROLES = (("command", "input"), ("volts", "output"))  # what the instrument twin computes
_FLAGS_UNIT = "bits"


@dataclass(frozen=True, slots=True)
class ExportReport:
    """Describes the written file or folder. ``notes`` say what was left out and why."""

    path: Path
    format: str
    rows: int
    columns: int
    notes: tuple[str, ...] = ()


def export(recording: Recording, out: Path, *, overwrite: bool = False) -> ExportReport:
    """Write ``recording`` in the format that the suffix of ``out`` names, or as a folder if ``out`` has no suffix.
    Columns keep their names, values every bit.

    Raises ``RecordingError`` when ``out`` exists, cannot be written, or the format is not there; ``InputError`` when
    the package that a format needs is not installed.
    """
    chosen = out.suffix.lower().removeprefix(".") or "folder"
    if chosen == "folder":
        return export_folder(recording, out)
    if chosen not in FORMATS:
        raise RecordingError(f"{out}: format {chosen!r} is unknown; use {', '.join(FORMATS)} or folder")
    with new_file(out, overwrite=overwrite) as part:
        FORMATS[chosen].write(recording, part)
    notes = ()
    if chosen == "mcap":
        notes = (f"for viewers; layouts for Foxglove and PlotJuggler are in {LAYOUTS}; --raw writes one to replay",)
    return ExportReport(out, chosen, recording.n_rows, len(recording.columns), notes)


def export_folder(recording: Recording, out: Path) -> ExportReport:
    """Write the recording folder of contracts/recordings-and-mismatch.md, section 1: ``recording.toml`` and its data.

    The commands are inputs, the volts of the DAQ outputs; the rest, computed from these volts with their noise, is no
    channel. Flags, and columns that are not finite throughout, are no channels either. The bench description stored in
    the recording becomes ``bench.toml`` and the twin's ``bench``.
    """
    refuse_existing(out, overwrite=False)
    finite = _finite_columns(recording)
    channels, notes = [], []
    computed = 0
    for index, (name, unit) in enumerate(recording.columns):
        if name == fmt.TIME_COLUMN:
            continue
        if unit == _FLAGS_UNIT:
            notes.append(f"{name} holds flags: it is in the data, but no channel")
        elif not finite[index]:
            notes.append(f"{name} is not a finite number throughout: it is in the data, but no channel")
        else:
            role = next((r for prefix, r in _ROLES if name == prefix or name.startswith(f"{prefix}_")), None)
            if role is None:
                computed += 1
                continue
            channels.append({"column": name, "role": role, "signal": name, "unit": unit})
    if computed:
        notes.append(f"{computed} columns that the firmware computed are in the data, but no channels")
    for role in ("input", "output"):
        if not any(channel["role"] == role for channel in channels):
            raise RecordingError(
                f"{recording.path}: no column has the role {role!r}: is it a recording of another instrument? "
                "Export it as csv and describe that with 'micron mismatch new'"
            )
    bench = recording.metadata.get("bench")
    parameters: dict[str, object] = {}
    with new_folder(out) as folder:
        if isinstance(bench, str):
            (folder / "bench.toml").write_text(bench, encoding="utf-8")
            parameters["bench"] = "bench.toml"
        _npz(recording, folder / "data.npz")
        clock = (
            {"time_column": fmt.TIME_COLUMN} if fmt.TIME_COLUMN in recording.names else {"rate_hz": recording.tick_hz}
        )
        head = {"format": 1, "title": recording.path.stem, "data": "data.npz", **clock}
        twin = {"kind": "instrument", "parameters": parameters}
        text = toml_text({**head, "twin": twin, "channels": channels})
        (folder / "recording.toml").write_text(text, encoding="utf-8")
    return ExportReport(out, "folder", recording.n_rows, len(recording.columns), tuple(notes))


def _finite_columns(recording: Recording) -> np.ndarray:
    finite = np.ones(len(recording.columns), dtype=bool)
    for block in recording.blocks():
        finite &= np.isfinite(block.data).all(axis=1)
    return finite


def _csv(recording: Recording, path: Path) -> None:
    with path.open("w", encoding="utf-8", newline="") as file:
        file.write(",".join(recording.names) + "\n")
        for block in recording.blocks():
            file.writelines(",".join(map(repr, row)) + "\n" for row in block.data.T.tolist())


def _npz(recording: Recording, path: Path) -> None:
    """Write one array per column while holding only one block: each column goes through a file of its own."""
    parts = path.parent / "columns"
    parts.mkdir()
    files = [(parts / str(i)).open("wb") for i in range(len(recording.columns))]
    try:
        header = {"descr": "<f8", "fortran_order": False, "shape": (recording.n_rows,)}
        for file in files:
            npy.write_array_header_1_0(file, header)
        for block in recording.blocks():
            for file, column in zip(files, block.data, strict=True):
                file.write(column.astype("<f8", copy=False).tobytes())
    finally:
        for file in files:
            file.close()
    with zipfile.ZipFile(path, "w", allowZip64=True) as archive:
        for i, name in enumerate(recording.names):
            archive.write(parts / str(i), f"{name}.npy")
    shutil.rmtree(parts)


@dataclass(frozen=True, slots=True)
class Format:
    """A file format that a recording is exported to. ``readers`` names what it is for."""

    readers: str
    write: Callable[[Recording, Path], object]


FORMATS: Mapping[str, Format] = MappingProxyType(
    {
        "csv": Format("tables, any program", _csv),
        "npz": Format("numpy", _npz),
        "parquet": Format("pandas, polars", parquet.write),
        "nc": Format("xarray, MATLAB: netCDF-4", netcdf.write),
        "mf4": Format("asammdf, CANape: ASAM MDF 4", mdf.write),
        "mcap": Format("Foxglove, PlotJuggler, rerun", view.write),
    }
)
"""Formats by the ending of a name, for ``micron export`` and the page."""
