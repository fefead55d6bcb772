"""Reading a recorded hand motion: what the file holds, in SI, on a uniform time base. Every fault is named.

``FILE`` is an .npz (units from the column names or from the ``meta.toml`` beside it; several recordings in one file are
told apart by ``recording_id`` and ``index.csv``), a .csv with a header row, or a recording of the contract (a .toml or
its folder). ``FILE#NAME`` chooses a recording by name or number, ``FILE#start:stop`` a part in seconds,
``FILE#NAME#start:stop`` both.
"""

from __future__ import annotations

import csv
import math
import tomllib
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from hal.arrays import Array
from hal.errors import BenchError
from hal.even_samples import evenly
from hal.npz import open_npz
from sim_devices.plant.sensors import STANDARD_GRAVITY

_UNITS = {
    "g": ("acceleration", STANDARD_GRAVITY),
    "mg": ("acceleration", 1e-3 * STANDARD_GRAVITY),
    "m/s^2": ("acceleration", 1.0),
    "m/s2": ("acceleration", 1.0),
    "m_s2": ("acceleration", 1.0),
    "m": ("displacement", 1.0),
    "mm": ("displacement", 1e-3),
    "um": ("displacement", 1e-6),
    "deg/s": ("angular rate", np.pi / 180.0),
    "deg_s": ("angular rate", np.pi / 180.0),
    "rad/s": ("angular rate", 1.0),
    "rad_s": ("angular rate", 1.0),
}
SHORTEST_S = 4.0


class HandFileError(BenchError):
    """A hand recording cannot be used: the message says which, where and what to do."""


class NoHandError(HandFileError):
    """A file can be read, but no column of it is a motion."""


@dataclass(frozen=True)
class HandRecording:
    """Holds one recorded motion on a uniform time base: arrays (n, 3) in SI, absent quantities ``None``.

    ``axes`` says which of the three columns were recorded; the others are zero. ``notes`` says what was mended.
    """

    name: str
    rate_hz: float
    acceleration: Array | None
    displacement: Array | None
    angular_rate: Array | None
    notes: tuple[str, ...]

    @property
    def seconds(self) -> float:
        return self._any().shape[0] / self.rate_hz

    def _any(self) -> Array:
        for signal in (self.acceleration, self.displacement, self.angular_rate):
            if signal is not None:
                return signal
        raise AssertionError("a hand recording holds at least one quantity")


def load_hand(source: str | Path) -> HandRecording:
    """Read ``FILE[#NAME][#start:stop]``. Raises HandFileError."""
    path, name, part = _address(str(source))
    units: dict[str, str] = {}
    rate_hz: float | None = None
    time_column = "t_s"
    if path.is_dir():
        path = path / "recording.toml"
    if path.suffix == ".toml":
        path, units, rate_hz, time_column = _contract(path)
    if path.suffix == ".npz":
        columns = _read_npz(path)
        meta_rate_hz, meta_units = _meta(path)
        rate_hz = rate_hz or meta_rate_hz
        units = units or {k: u for k, u in meta_units.items() if k in columns}
        columns = _choose(path, columns, name)
    elif path.suffix == ".csv":
        columns = _read_csv(path)
        if name:
            raise HandFileError(f"{path} is one recording: '#{name}' names none in it; leave it out")
    else:
        raise HandFileError(f"{path}: a hand is an .npz, a .csv or a recording folder (.toml)")
    t = columns.get(time_column)
    signals = _signals(path, columns, units)
    return _uniform(f"{path.name}{'#' + name if name else ''}", path, signals, t, rate_hz, part)


def _address(source: str) -> tuple[Path, str, tuple[float, float] | None]:
    pieces = source.split("#")
    name, part = "", None
    for piece in pieces[1:]:
        if ":" in piece:
            try:
                start, stop = (float(v) for v in piece.split(":"))
            except ValueError:
                raise HandFileError(f"'#{piece}': a part is #start:stop in seconds, e.g. #10:40") from None
            if not 0.0 <= start < stop:
                raise HandFileError(f"'#{piece}': a part starts at 0 s or later and stops after it starts")
            part = start, stop
        else:
            name = piece
    return Path(pieces[0]), name, part


def _read_npz(path: Path) -> dict[str, Array]:
    try:
        with open_npz(path) as data:
            return {k: data[k] for k in data.files}
    except FileNotFoundError:
        raise HandFileError(f"{path} does not exist; name an .npz, a .csv or a recording folder") from None
    except (OSError, ValueError) as error:
        raise HandFileError(f"{path} is not a readable .npz of plain arrays: {error}") from error


def _read_csv(path: Path) -> dict[str, Array]:
    try:
        with path.open(newline="", encoding="utf-8-sig") as file:
            rows = list(csv.reader(file))
    except FileNotFoundError:
        raise HandFileError(f"{path} does not exist; name an .npz, a .csv or a recording folder") from None
    except (OSError, UnicodeDecodeError, csv.Error) as error:
        raise HandFileError(f"{path} is not a readable .csv: {error}") from error
    if len(rows) < 2:
        raise HandFileError(f"{path} holds no data below its header row")
    header = [h.strip() for h in rows[0]]
    values = np.empty((len(rows) - 1, len(header)))
    for n, row in enumerate(rows[1:], start=2):
        if len(row) != len(header):
            raise HandFileError(f"{path} line {n}: {len(row)} values, the header has {len(header)}")
        try:
            values[n - 2] = [float(v) for v in row]
        except ValueError as error:
            raise HandFileError(f"{path} line {n}: {error}; correct or delete this line") from None
    return {h: values[:, i] for i, h in enumerate(header)}


def _toml(path: Path) -> dict[str, Any]:
    try:
        return tomllib.loads(path.read_text(encoding="utf-8-sig"))
    except FileNotFoundError:
        raise HandFileError(f"{path} does not exist; name an .npz, a .csv or a recording folder") from None
    except (OSError, UnicodeDecodeError, tomllib.TOMLDecodeError) as error:
        raise HandFileError(f"{path}: {error}") from error


def _contract(path: Path) -> tuple[Path, dict[str, str], float | None, str]:
    """Data file, unit of each measured column, rate and time column of a recording of the contract."""
    table = _toml(path)
    data = table.get("data")
    if not isinstance(data, str):
        raise HandFileError(f"{path}: key 'data' (the data file's name) is missing")
    channels = table.get("channels")
    units = {
        str(c.get("column")): str(c.get("unit"))
        for c in (channels if isinstance(channels, list) else [])
        if isinstance(c, dict) and c.get("role") != "context" and str(c.get("unit")) in _UNITS
    }
    if not units:
        raise HandFileError(f"{path}: no channel is an acceleration, a displacement or an angular rate")
    rate_hz, time_column = table.get("rate_hz"), table.get("time_column", "t_s")
    if not (rate_hz is None or (isinstance(rate_hz, int | float) and 0.0 < rate_hz < math.inf)):
        raise HandFileError(f"{path}: rate_hz must be a positive number, got {rate_hz!r}")
    return path.parent / data, units, rate_hz, str(time_column)


def _meta(path: Path) -> tuple[float | None, dict[str, str]]:
    meta = path.parent / "meta.toml"
    if not meta.exists():
        return None, {}
    table = _toml(meta)
    units = {k: str(v.get("unit")) for k, v in table.get("columns", {}).items() if isinstance(v, dict)}
    return table.get("rate_fitted_hz") or table.get("rate_hz"), units


def _choose(path: Path, columns: dict[str, Array], name: str) -> dict[str, Array]:
    if "recording_id" not in columns:
        if name:
            raise HandFileError(f"{path} is one recording: '#{name}' names none in it; leave it out")
        return columns
    ids = columns["recording_id"]
    names = {str(i): int(i) for i in np.unique(ids)}
    index = path.parent / "index.csv"
    if index.exists():
        with index.open(newline="", encoding="utf-8-sig") as file:
            names |= {r["name"]: int(r["recording_id"]) for r in csv.DictReader(file)}
    if name not in names:
        known = ", ".join(n for n in names if not n.isdigit()) or ", ".join(names)
        what = f"has no recording '{name}'" if name else f"holds {len(np.unique(ids))} recordings"
        raise HandFileError(f"{path} {what}: choose one with {path.name}#NAME; names: {known}")
    return {k: v[ids == names[name]] for k, v in columns.items() if k != "recording_id"}


def _signals(path: Path, columns: dict[str, Array], units: dict[str, str]) -> dict[str, Array]:
    """Return (n, 3) per quantity, in SI. Columns fill x, y, z by their name (_x, _y, _z), else in their order."""
    by_quantity: dict[str, list[tuple[str, Array]]] = {}
    for column, values in columns.items():
        unit = units.get(column, "") if units else _unit_of(column)
        if unit not in _UNITS:
            continue
        quantity, factor = _UNITS[unit]
        values = np.asarray(values, dtype=np.float64)
        if values.ndim != 1:
            raise HandFileError(f"{path}: column '{column}' is not one row of numbers")
        bad = np.flatnonzero(~np.isfinite(values))
        if bad.size:
            raise HandFileError(f"{path}: column '{column}' is not a number at sample {bad[0]}")
        by_quantity.setdefault(quantity, []).append((column, values * factor))
    missing = [c for c in units if c not in columns and units[c] in _UNITS]
    if missing and not by_quantity:
        raise HandFileError(f"{path}: column '{missing[0]}' is missing")
    if not by_quantity:
        raise NoHandError(
            f"{path}: no column is an acceleration, a displacement or an angular rate; "
            f"columns: {', '.join(columns)}; names end in a unit (_g, _m_s2, _um, _deg_s) or meta.toml tells it"
        )
    signals = {}
    for quantity, list_of in by_quantity.items():
        if len(list_of) > 3:
            raise HandFileError(f"{path}: {len(list_of)} columns of {quantity}, a hand has at most three")
        signal = np.zeros((len(list_of[0][1]), 3))
        for n, (column, values) in enumerate(list_of):
            if len(values) != len(signal):
                raise HandFileError(f"{path}: column '{column}' has another length than the others")
            signal[:, _axis_of(column, n)] = values
        signals[quantity] = signal
    return signals


def _unit_of(column: str) -> str:
    """Longest known unit that the name ends in, after an underscore."""
    fits = [u for u in _UNITS if column.endswith("_" + u)]
    return max(fits, key=len) if fits else ""


def _axis_of(column: str, order: int) -> int:
    pieces = column.lower().split("_")
    return next((i for i, axis in enumerate("xyz") if axis in pieces), order)


def _uniform(
    name: str,
    path: Path,
    signals: dict[str, Array],
    t: Array | None,
    rate_hz: float | None,
    part: tuple[float, float] | None,
) -> HandRecording:
    notes: list[str] = []
    if t is not None:
        signals, rate_hz = _even(path, signals, np.asarray(t, dtype=np.float64), notes)
    if not rate_hz or rate_hz <= 0.0:
        raise HandFileError(f"{path}: no sampling rate: neither a column t_s nor rate_hz in meta.toml or the .toml")
    count = len(next(iter(signals.values())))
    if part is not None:
        first, last = round(part[0] * rate_hz), round(part[1] * rate_hz)
        if last > count:
            raise HandFileError(f"{path}: part {part[0]:g}:{part[1]:g} s, but it ends at {count / rate_hz:.2f} s")
        signals = {k: v[first:last] for k, v in signals.items()}
        count = last - first
    if count / rate_hz < SHORTEST_S:
        raise HandFileError(f"{path}: {count / rate_hz:.2f} s of motion; a hand needs {SHORTEST_S:g} s or more")
    if rate_hz < 30.0:
        raise HandFileError(f"{path}: sampled at {rate_hz:.1f} Hz; tremor up to 12 Hz needs 30 Hz or more")
    return HandRecording(
        name=name,
        rate_hz=float(rate_hz),
        acceleration=signals.get("acceleration"),
        displacement=signals.get("displacement"),
        angular_rate=signals.get("angular rate"),
        notes=tuple(notes),
    )


def _even(path: Path, signals: dict[str, Array], t: Array, notes: list[str]) -> tuple[dict[str, Array], float]:
    """Signals on a uniform time base and its rate; jittering stamps are judged by what sees the fastest changes."""
    judge = next(signals[k] for k in ("angular rate", "acceleration", "displacement") if k in signals)
    names = list(signals)
    together = np.concatenate([signals[name] for name in names], axis=1)
    try:
        even, rate_hz, _, mended = evenly(t, together, judge)
    except ValueError as error:
        raise HandFileError(f"{path}: {error}") from None
    notes += mended
    return {name: even[:, 3 * n : 3 * n + 3] for n, name in enumerate(names)}, rate_hz
