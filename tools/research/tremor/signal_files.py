"""Any other recording as tremor signals: .npz, .csv, or a recording of the contract."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from pathlib import Path

import numpy as np

from hal.arrays import Array
from hal.even_samples import evenly
from tools.errors import InputError
from tools.mismatch import units
from tools.research.tremor.signal import TremorSignal

_QUANTITIES = (("acceleration", "m/s^2"), ("angular rate", "rad/s"), ("displacement", "m"))
_SUFFIXES = {"m_s2": "m/s^2", "m_s_2": "m/s^2", "rad_s": "rad/s", "deg_s": "deg/s", "dps": "deg/s"} | {
    unit: unit for unit in ("g", "mg", "m", "mm", "um", "nm")
}
_TIMES = ("t_s", "time_s")


def read_file(path: Path) -> Iterator[TremorSignal]:
    """Read a signal per quantity in the file: acceleration, angular rate, displacement. Raises InputError."""
    if path.is_dir() and (path / "recording.toml").is_file():
        path = path / "recording.toml"
    if path.is_dir():
        path = path / "data.npz"
        if not path.is_file():
            raise InputError(f"{path.parent}: neither recording.toml nor data.npz; name the file")
    if path.suffix == ".toml":
        yield from _contract(path)
        return
    stated_hz: float | None = None
    if path.suffix == ".npz":
        from tools.calibrate.logs import load_log

        log = load_log(path)
        columns, stated = log.columns, log.meta.get("rate_hz")
        stated_hz = float(stated) if isinstance(stated, int | float) else None
    elif path.suffix == ".csv":
        columns = _csv(path)
    else:
        raise InputError(f"{path}: a tremor recording is an .npz, a .csv, or a recording folder (.toml)")
    found = {name: unit for name in columns if (unit := _unit_of(name))}
    yield from _signals(path, columns, found, stated_hz)


def _csv(path: Path) -> dict[str, Array]:
    from tools.mismatch.recording_columns import column_names, read_columns

    names = column_names(path)
    wanted = [name for name in names if name in _TIMES or _unit_of(name)]
    if not wanted:
        raise InputError(f"{path}: no column ends in a unit (_g, _m_s2, _deg_s, _um, ...); the header is: {names}")
    return read_columns(path, wanted)


def _contract(path: Path) -> Iterator[TremorSignal]:
    from tools.mismatch.recording_load import load

    recording = load(path)
    columns = {**recording.inputs, **recording.outputs}
    found = {
        name: recording.unit[name]
        for name in columns
        if any(units.same_dimension(recording.unit[name], unit) for _, unit in _QUANTITIES)
    }
    yield from _signals(path, columns, found, 1.0 / recording.dt)


def _unit_of(column: str) -> str:
    """Unit that the name ends in, the longest that fits; empty if none."""
    fits = [suffix for suffix in _SUFFIXES if column.endswith("_" + suffix)]
    return _SUFFIXES[max(fits, key=len)] if fits else ""


def _signals(
    path: Path, columns: Mapping[str, Array], unit_of: Mapping[str, str], stated_hz: float | None
) -> Iterator[TremorSignal]:
    stamps = next((columns[name] for name in _TIMES if name in columns), None)
    if stamps is None and stated_hz is None:
        raise InputError(f"{path}: neither a column t_s nor rate_hz in a meta.toml beside it; add one of them")
    any_found = False
    for quantity, unit in _QUANTITIES:
        names = [name for name, u in unit_of.items() if units.same_dimension(u, unit)]
        if not names:
            continue
        any_found = True
        values = np.stack([units.convert(columns[name], unit_of[name], unit) for name in names], axis=1)
        if not np.all(np.isfinite(values)):
            row, column = np.argwhere(~np.isfinite(values))[0]
            raise InputError(f"{path}: '{names[column]}' is not finite at sample {row}; cut the recording there")
        rate_hz, start_s, notes = stated_hz or 0.0, 0.0, ()
        if stamps is not None:
            try:
                values, rate_hz, start_s, notes = evenly(stamps, values)
            except ValueError as error:
                raise InputError(f"{path}: {error}") from None
            if stated_hz is not None and abs(stated_hz / rate_hz - 1.0) > 2e-3:
                notes = (*notes, f"the time stamps say {rate_hz:.2f} Hz, not the stated {stated_hz:g} Hz")
        yield TremorSignal(
            name=f"{path.parent.name}/{path.stem}" + (f"/{quantity}" if len(unit_of) > len(names) else ""),
            data_set=path.parent.name,
            subject=path.stem,
            quantity=quantity,
            unit=unit,
            axes=tuple(names),
            values=values,
            rate_hz=float(rate_hz),
            stated_rate_hz=float(stated_hz or rate_hz),
            start_s=start_s,
            notes=notes,
        )
    if not any_found:
        raise InputError(
            f"{path}: no acceleration, angular rate or displacement; columns: {', '.join(columns)}; "
            "names end in their unit (_g, _m_s2, _deg_s, _um)"
        )
