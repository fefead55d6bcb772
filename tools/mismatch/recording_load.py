"""Loads a descriptor as a Recording (contract, section 1) and names every fault."""

from __future__ import annotations

import re
import tomllib
from collections.abc import Mapping
from dataclasses import dataclass
from datetime import UTC, date, datetime
from pathlib import Path
from typing import Any, get_args

import numpy as np

from hal.trust import path_inside
from tools.errors import RecordingError
from tools.mismatch import units
from tools.mismatch.input_noise import conditional_mean
from tools.mismatch.recording import Array, Condition, Recording, Split, TwinText
from tools.mismatch.recording_columns import SUFFIXES, column_units, read_columns
from tools.mismatch.twins.vocabulary import KINDS, Role, Vocabulary, user_kinds, vocabulary

MIN_SAMPLES = 50
MIN_SPAN = 30  # least samples of a [split] range
LONGEST_GAP = 20.0  # longest gap that is filled, in usual steps of a time column
MOST_MISSING = 0.02  # of the time
CUT = "'micron mismatch cut RECORDING --out FOLDER' keeps the longest stretch without gaps"
MOST_SIZE = 1e100  # of any value: squares must stay finite
_TOP = {"format", "title", "data", "rate_hz", "time_column", "twin", "channels", "split", "segments", "conditions"}
_CHANNEL = {"column", "role", "signal", "unit", "noise_rms", "resolution", "tolerance"}


@dataclass(frozen=True)
class _Channel:
    column: str
    role: Role
    signal: str
    unit: str
    to: str
    noise: float | None
    step: float | None
    tolerance: float | None = None

    def scaled(self, difference: float | None) -> float | None:
        """Return a difference that the descriptor gives in the channel's unit in the unit of the twin."""
        return None if difference is None else units.convert_difference(difference, self.unit, self.to)


def load(path: Path | str) -> Recording:
    """Load the recording of a descriptor (a folder with ``recording.toml``, or any ``.toml``), check and convert it.

    Raises RecordingError for any fault.
    """
    path = Path(path)
    if path.is_dir():
        path = path / "recording.toml"
    return from_table(path, _toml(path))


def from_table(
    path: Path, text: Mapping[str, Any], columns: Mapping[str, Array] | None = None, twin: TwinText | None = None
) -> Recording:
    """Build the recording that a descriptor's table describes, checked and converted. Messages name ``path``.

    If given, ``columns`` (n,) by name replace the data file, and ``twin`` the table ``[twin]``. Raises RecordingError
    for any fault.
    """
    where = str(path)
    if text.get("format") != 1:
        raise RecordingError(f"{where}: format must be 1, got {text.get('format')!r}")
    if "channels" not in text:
        raise RecordingError(f"{where}: no [[channels]]; describe each column that is used")
    data_name = text.get("data")
    if columns is None and not isinstance(data_name, str):
        raise RecordingError(f"{where}: 'data' must name the data file ({', '.join(SUFFIXES)}), got {data_name!r}")
    if twin is None:
        twin, words = _twin(where, _twin_table(path, text.get("twin")))
    else:
        words = Vocabulary(open_ended=True)
    notes = [f"key '{k}' is unknown and not used" for k in text if k not in _TOP]
    data_path = path if columns is not None else path_inside(path, str(data_name))
    in_file = column_units(data_path) if columns is None and data_path.is_file() else {}
    channels = _channels(where, text["channels"], words, twin.kind, notes, in_file)
    rate, time_column = _clock(where, text)
    names = [c.column for c in channels]
    if time_column is not None and time_column not in names:
        names.append(time_column)
    columns = read_columns(data_path, names) if columns is None else {name: columns[name] for name in names}
    _check_samples(data_path, columns)
    on_new_grid = False
    if time_column is not None:
        stamps = columns[time_column]
        dt, grid = _step(data_path, time_column, stamps, rate, notes)
        if grid is not None:
            columns = {name: on_grid(grid, dt, stamps, x) for name, x in columns.items()}
            on_new_grid = True
    else:
        assert rate is not None
        dt = 1.0 / rate
    n = columns[names[0]].size
    segments = _segments(path, text.get("segments"), n, twin.kind, on_new_grid)
    parts: dict[Role, dict[str, Array]] = {"input": {}, "output": {}, "context": {}}
    for c in channels:
        parts[c.role][c.signal] = _converted(data_path, c, columns[c.column], notes)
    input_noise = {c.signal: noise for c in channels if c.role == "input" and (noise := c.scaled(c.noise)) is not None}
    for signal, noise in input_noise.items():
        parts["input"][signal] = conditional_mean(parts["input"][signal], noise, segments)
    _same_data(data_path, channels, columns, notes)
    recording = Recording(
        path=path,
        title=str(text.get("title", path.stem)),
        t=np.asarray(np.arange(n) * dt, np.float64),
        dt=dt,
        inputs=parts["input"],
        outputs=parts["output"],
        context=parts["context"],
        noise={c.signal: c.scaled(c.noise) for c in channels if c.role == "output"},
        unit={c.signal: c.to for c in channels},
        declared_unit={c.signal: c.unit for c in channels},
        column={c.signal: c.column for c in channels},
        twin=twin,
        split=_split(path, text.get("split"), n),
        declared_step={c.signal: step for c in channels if (step := c.scaled(c.step)) is not None},
        tolerance={c.signal: most for c in channels if (most := c.scaled(c.tolerance)) is not None},
        warnings=tuple(notes),
        segments=segments,
        input_noise=input_noise,
        conditions=_conditions(where, text.get("conditions")),
    )
    if twin.kind in ("state_space", "ode"):
        from tools.mismatch.recording_units import in_twin_units

        return in_twin_units(recording)
    return recording


def _clock(where: str, text: Mapping[str, Any]) -> tuple[float | None, str | None]:
    """Return the rate in Hz and the name of the time column; at least one of them is given."""
    rate, time_column = _number(where, "rate_hz", text.get("rate_hz")), text.get("time_column")
    if rate is None and time_column is None:
        raise RecordingError(f"{where}: neither 'rate_hz' nor 'time_column'; give one of them")
    if rate is not None and rate <= 0:
        raise RecordingError(f"{where}: rate_hz must be positive, got {rate}")
    if time_column is not None and not isinstance(time_column, str):
        raise RecordingError(f"{where}: time_column must be a column name, got {time_column!r}")
    return rate, time_column


def _check_samples(data_path: Path, columns: Mapping[str, Array]) -> None:
    """Refuse data that are too short, or that hold a value which is no finite number."""
    n = next(iter(columns.values())).size
    if n < MIN_SAMPLES:
        raise RecordingError(
            f"{data_path}: {n} samples; at least {MIN_SAMPLES} are needed to tell physics from noise;"
            f" record longer, or as long at {np.ceil(MIN_SAMPLES / n):g} times the rate"
        )
    for name, values in columns.items():
        bad = ~np.isfinite(values)
        if bad.any():
            i = int(np.argmax(bad))
            line = f" (line {i + 2})" if data_path.suffix.lower() == ".csv" else ""
            raise RecordingError(f"{data_path}: column '{name}' sample {i}{line}: {values[i]}; {CUT}")


def _converted(data_path: Path, c: _Channel, column: Array, notes: list[str]) -> Array:
    """Return a channel in the unit of the twin. Raises RecordingError for sizes and outputs that cannot be right."""
    values = units.convert(column, c.unit, c.to)
    size = float(np.max(np.abs(values)))
    if size > MOST_SIZE or 0 < size < 1 / MOST_SIZE:
        raise RecordingError(
            f"{data_path}: column '{c.column}' reaches {size:g} {c.to}; the unit or the data are wrong"
        )
    if np.ptp(values) == 0.0:
        if c.role == "output":
            raise RecordingError(
                f"{data_path}: column '{c.column}' (output '{c.signal}') never changes from {values[0]}"
                " sample 0 to the end; a dead sensor or the wrong column"
            )
        notes.append(f"column '{c.column}' ({c.role} '{c.signal}') never changes")
    return values


def descriptor(path: Path) -> dict[str, Any]:
    """Return the table of a descriptor, unchecked. Raises RecordingError if it does not exist or is not TOML."""
    return _toml(path)


def _toml(path: Path) -> dict[str, Any]:
    if not path.is_file():
        raise RecordingError(f"{path}: no such recording; give a folder with recording.toml or a .toml file")
    try:
        return tomllib.loads(path.read_text(encoding="utf-8"))
    except tomllib.TOMLDecodeError as error:
        raise RecordingError(f"{path}: not valid TOML: {error}") from None
    except UnicodeDecodeError as error:
        raise RecordingError(f"{path}: not UTF-8 text ({error.reason})") from None


def _number(where: str, key: str, value: object) -> float | None:
    if value is None:
        return None
    if isinstance(value, bool) or not isinstance(value, int | float) or not np.isfinite(value):
        raise RecordingError(f"{where}: {key} must be a finite number, got {value!r}")
    return float(value)


def _twin_table(path: Path, value: object) -> object:
    """Return the [twin] table, or that of the twin file which it names."""
    if not isinstance(value, Mapping) or "file" not in value:
        return value
    name = value["file"]
    if not isinstance(name, str) or len(value) > 1:
        raise RecordingError(f"{path}: [twin] file must be the name of a twin file, and stand alone")
    other = path_inside(path, name)
    if not other.is_file():
        raise RecordingError(f"{path}: [twin] file: {other} does not exist")
    table = _toml(other).get("twin")
    if not isinstance(table, Mapping):
        raise RecordingError(f"{other}: no [twin] table; write one with 'micron mismatch apply'")
    return table


def load_twin(path: Path) -> TwinText:
    """Return the ``[twin]`` table of a twin file. Raises RecordingError for any fault."""
    table = _toml(path).get("twin")
    if not isinstance(table, Mapping):
        raise RecordingError(f"{path}: no [twin] table; write one with 'micron mismatch apply'")
    return _twin(str(path), table)[0]


def _twin(where: str, value: object) -> tuple[TwinText, Vocabulary]:
    if not isinstance(value, Mapping) or not isinstance(value.get("kind"), str):
        raise RecordingError(f"{where}: no [twin] with a 'kind'; known kinds: {', '.join(KINDS)}")
    kind = value["kind"]
    words = vocabulary(kind)
    if words is None:
        known = ", ".join([*KINDS, *user_kinds()])
        raise RecordingError(f"{where}: [twin] kind '{kind}' is unknown; known kinds: {known}")
    parameters = value.get("parameters", {})
    effects = value.get("effects", [])
    if not isinstance(parameters, Mapping):
        raise RecordingError(f"{where}: [twin.parameters] must be a table")
    if kind == "state_space" and "states" in value:
        parameters = {**parameters, "states": value["states"]}
    if kind == "ode":
        parameters = {**parameters, **{k: v for k, v in value.items() if k not in ("kind", "parameters", "effects")}}
    if not isinstance(effects, list) or not all(isinstance(e, Mapping) for e in effects):
        raise RecordingError(f"{where}: [[twin.effects]] must be tables")
    return TwinText(kind, dict(parameters), tuple(effects)), words


def _channels(
    where: str, value: object, words: Vocabulary, kind: str, notes: list[str], in_file: Mapping[str, str]
) -> list[_Channel]:
    if not isinstance(value, list) or not value:
        raise RecordingError(f"{where}: [[channels]] must be a list of tables")
    out: list[_Channel] = []
    signals: dict[str, int] = {}
    columns: dict[str, int] = {}
    for i, entry in enumerate(value):
        at = f"{where}: [[channels]] {i + 1}"
        if not isinstance(entry, Mapping):
            raise RecordingError(f"{at}: must be a table")
        for key in ("column", "role", "signal"):
            if not isinstance(entry.get(key), str) or not entry[key]:
                raise RecordingError(f"{at}: '{key}' is missing or not a text")
        column, role, signal = entry["column"], entry["role"], entry["signal"]
        for key in ("column", "signal"):  # both stand in the text of exported programs
            if not entry[key].isprintable() or set(entry[key]) & {'"', "\\"}:
                raise RecordingError(f"{at}: '{key}' holds quotes, backslashes or unprintable characters; rename it")
        at += f" ('{column}')"
        notes.extend(f"[[channels]] {i + 1}: key '{k}' is unknown and not used" for k in entry if k not in _CHANNEL)
        if role not in get_args(Role):
            raise RecordingError(f"{at}: role must be input, output or context, got '{role}'")
        if signal in signals:
            raise RecordingError(
                f"{at}: signal '{signal}' is already taken by [[channels]] {signals[signal]}; one column per signal"
            )
        if column in columns:
            raise RecordingError(f"{at}: column '{column}' is already used by [[channels]] {columns[column]}")
        signals[signal], columns[column] = i + 1, i + 1
        allowed = words.units(role, signal)
        if allowed is None:
            raise RecordingError(f"{at}: {kind} has no {role} '{signal}'; it has: {words.known(role)}")
        unit, to = _unit(at, entry.get("unit", in_file.get(column)), allowed, signal, notes)
        noise = _positive(at, "noise_rms", entry.get("noise_rms"))
        step = _positive(at, "resolution", entry.get("resolution"))
        if noise is not None and role == "context":
            notes.append(f"[[channels]] {i + 1}: noise_rms of a context channel is not used")
        tolerance = _positive(at, "tolerance", entry.get("tolerance"))
        if tolerance is not None and role != "output":
            notes.append(f"[[channels]] {i + 1}: tolerance of a channel that is no output is not used")
            tolerance = None
        out.append(_Channel(column, role, signal, unit, to, noise, step, tolerance))
    if not any(c.role == "output" for c in out):
        raise RecordingError(f"{where}: no channel with role = 'output': there is nothing to compare the twin with")
    if not any(c.role == "input" for c in out):
        raise RecordingError(f"{where}: no channel with role = 'input': the twin has nothing to run on")
    _together(where, kind, out)
    return out


def _positive(at: str, key: str, value: object) -> float | None:
    number = _number(at, key, value)
    if number is not None and number <= 0:
        raise RecordingError(f"{at}: {key} must be positive, got {number}; leave it out if it is unknown")
    return number


def _unit(at: str, value: object, allowed: tuple[str, ...], signal: str, notes: list[str]) -> tuple[str, str]:
    if value is None:
        to = allowed[0] if allowed else "1"
        notes.append(f"{signal}: no unit given, taken as {to}")
        return to, to
    if not isinstance(value, str):
        raise RecordingError(f"{at}: unit must be a text such as 'V', got {value!r}")
    try:
        parsed = units.parse(value)
    except units.UnitError as error:
        raise RecordingError(f"{at}: {error}; use SI or {', '.join(allowed) or 'V, um, deg/s, G, ...'}") from None
    if not allowed:
        return value, value
    for to in allowed:
        if units.parse(to).dimension == parsed.dimension:
            return value, to
    raise RecordingError(f"{at}: unit '{value}' is not of the dimension of {' or '.join(allowed)}")


def _together(where: str, kind: str, channels: list[_Channel]) -> None:
    """Return what one channel demands of the others."""
    inputs = {c.signal for c in channels if c.role == "input"}
    outputs = {c.signal: c for c in channels if c.role == "output"}
    if kind in ("accelerometer", "magnetometer"):
        prefix = "specific_force" if kind == "accelerometer" else "field"
        for o in outputs:
            if f"{prefix}_{o[-1]}" not in inputs:
                raise RecordingError(f"{where}: output '{o}' needs the input '{prefix}_{o[-1]}'; add it or drop {o}")
    if kind == "accelerometer_cluster":
        for o in outputs:
            if f"specific_force_{o[-1]}" not in inputs:
                raise RecordingError(f"{where}: output '{o}' needs the input 'specific_force_{o[-1]}'")
    if kind == "mechanical_axis":
        if len(inputs) > 1:
            raise RecordingError(f"{where}: mechanical_axis takes force or torque, not both")
        angular = "torque" in inputs
        for o, c in outputs.items():
            if ("rad" in c.to) != angular:
                raise RecordingError(f"{where}: {o} in {c.to} does not go with the input {', '.join(inputs)}")


def _step(path: Path, name: str, stamps: Array, rate: float | None, notes: list[str]) -> tuple[float, Array | None]:
    """Return the time step of a monotonic time column, and the uniform grid to resample it to.

    A grid is needed where the column is not uniform to half a sample, because of a few short gaps or a wandering clock.
    """
    d = np.diff(stamps)
    back = d <= 0
    if back.any():
        i = int(np.argmax(back)) + 1
        what = "stands still" if d[i - 1] == 0 else "runs backwards"
        raise RecordingError(
            f"{path}: time column '{name}' {what} at sample {i} ({stamps[i - 1]:g} then {stamps[i]:g} s);"
            " 'micron mismatch cut RECORDING --out FOLDER' sorts it"
        )
    dt, median = float(stamps[-1] - stamps[0]) / d.size, float(np.median(d))
    gap = d > 1.5 * median
    missing = float(np.sum(d[gap] - median))
    if gap.any() and (d.max() > LONGEST_GAP * median or missing > MOST_MISSING * (stamps[-1] - stamps[0])):
        i = int(np.argmax(d)) + 1
        raise RecordingError(
            f"{path}: time column '{name}' jumps by {d[i - 1]:g} s at sample {i}, the usual step is {median:g} s; {CUT}"
        )
    grid: Array | None = None
    off = np.abs(stamps - (stamps[0] + dt * np.arange(stamps.size)))
    if gap.any() or off.max() > 0.5 * dt:
        # the mean step between the gaps: the median is quantised like the stamps
        dt = float(np.mean(d[~gap]))
        count = round(float(stamps[-1] - stamps[0]) / dt)
        dt = float(stamps[-1] - stamps[0]) / count
        grid = stamps[0] + dt * np.arange(count + 1)
        lost = f"{int(gap.sum())} gaps, {missing:.3g} s in all, filled by straight lines" if gap.any() else "no gaps"
        notes.append(f"time column '{name}' is not uniform: brought to a grid of {dt:.6g} s ({lost})")
    elif off.max() > 0.01 * dt:
        notes.append(f"time stamps scatter by up to {off.max() / dt:.2g} of a step; taken as uniform")
    if rate is not None and abs(rate * dt - 1) > 0.2:
        raise RecordingError(f"{path}: rate_hz {rate:g} contradicts the time column '{name}' ({1 / dt:g} Hz)")
    if rate is not None and abs(rate * dt - 1) > 1e-3:
        notes.append(f"rate_hz {rate:g} differs from the time column ({1 / dt:.6g} Hz); the time column is used")
    return dt, grid


def uniform(
    path: Path, columns: Mapping[str, Array], time_column: str | None, rate_hz: float | None
) -> tuple[float, dict[str, Array]]:
    """Return the time step in s and the columns (n,) at that step. Raises RecordingError for a broken time column."""
    if time_column is None:
        if rate_hz is None or not 0 < rate_hz < np.inf:
            raise RecordingError(f"{path}: neither 'rate_hz' nor 'time'; give one of them")
        return 1.0 / rate_hz, dict(columns)
    stamps = columns[time_column]
    dt, grid = _step(path, time_column, stamps, rate_hz, [])
    if grid is None:
        return dt, dict(columns)
    return dt, {name: on_grid(grid, dt, stamps, x) for name, x in columns.items()}


def on_grid(grid: Array, dt: float, stamps: Array, x: Array) -> Array:
    """Take the nearest sample per grid point (interpolation would smooth the noise), and a straight line in gaps."""
    after = np.clip(np.searchsorted(stamps, grid), 1, stamps.size - 1)
    nearest = np.where(grid - stamps[after - 1] < stamps[after] - grid, after - 1, after)
    near = np.abs(stamps[nearest] - grid) <= 0.75 * dt
    return np.where(near, x[nearest], np.interp(grid, stamps, x))


def _same_data(path: Path, channels: list[_Channel], columns: dict[str, Array], notes: list[str]) -> None:
    for i, a in enumerate(channels):
        for b in channels[:i]:
            if np.array_equal(columns[a.column], columns[b.column]) and np.ptp(columns[a.column]) > 0:
                if "output" in (a.role, b.role) and a.role != b.role:
                    raise RecordingError(
                        f"{path}: columns '{b.column}' ({b.role}) and '{a.column}' ({a.role}) hold the same numbers;"
                        " one of them is the wrong column"
                    )
                notes.append(f"columns '{b.column}' and '{a.column}' hold the same numbers")


def _enough(path: Path, found: Mapping[str, tuple[int, int] | Path], initialization: int) -> None:
    """Check that the ranges are long enough for a fit and a score and share no samples."""
    for key, skip in (("fit", 0), ("test", initialization)):
        span = found.get(key)
        if isinstance(span, tuple) and span[1] - span[0] - skip < MIN_SPAN:
            raise RecordingError(
                f"{path}: [split] {key}: {span[1] - span[0] - skip} samples to go by; at least {MIN_SPAN} are needed"
            )
        if isinstance(span, Path) and span.resolve() == path.resolve():
            raise RecordingError(f"{path}: [split] {key} names this recording itself; give a range of samples")
    fit, test = found.get("fit"), found.get("test")
    if isinstance(fit, tuple) and isinstance(test, tuple) and fit[0] < test[1] and test[0] < fit[1]:
        raise RecordingError(f"{path}: [split] fit {list(fit)} and test {list(test)} share samples")


APART = ("state_space", "mechanical_axis", "ode", "piezo_stack", "accelerometer", "magnetometer")
"""Kinds of twins whose plants restart at a segment, or have no state."""


def _segments(path: Path, value: object, n: int, kind: str, resampled: bool) -> tuple[int, ...]:
    """Return the samples at which further runs begin."""
    if value is None:
        return ()
    if not isinstance(value, list) or not all(isinstance(i, int) and not isinstance(i, bool) for i in value):
        raise RecordingError(f"{path}: segments must be a list of samples at which a new run begins, got {value!r}")
    lengths = np.diff([0, *value, n])
    if np.any(lengths < MIN_SPAN):
        raise RecordingError(
            f"{path}: segments {value} leave a run of {int(lengths.min())} of the {n} samples; each needs {MIN_SPAN},"
            " in rising order"
        )
    if kind not in APART:
        raise RecordingError(f"{path}: a twin of kind '{kind}' runs through; make a recording of each of the segments")
    if resampled:
        raise RecordingError(f"{path}: segments count samples, which an irregular time column does not keep; {CUT}")
    return tuple(value)


def _conditions(where: str, value: object) -> dict[str, Condition]:
    """Return the conditions of the recording. Dates become days since 1970; one without an offset is read as UTC."""
    if value is None:
        return {}
    if not isinstance(value, Mapping):
        raise RecordingError(f"{where}: [conditions] must be a table of numbers, texts or dates, got {value!r}")
    found: dict[str, Condition] = {}
    for key, item in value.items():
        if isinstance(item, date):
            full = item if isinstance(item, datetime) else datetime(item.year, item.month, item.day)
            found[key] = (full if full.tzinfo else full.replace(tzinfo=UTC)).timestamp() / 86400.0
        elif isinstance(item, str):
            found[key] = item
        elif isinstance(item, int | float) and not isinstance(item, bool) and np.isfinite(item):
            found[key] = float(item)
        else:
            raise RecordingError(f"{where}: [conditions] {key} must be a number, a text or a date, got {item!r}")
    return found


def _split(path: Path, value: object, n: int) -> Split:
    if value is None:
        return Split()
    if not isinstance(value, Mapping):
        raise RecordingError(f"{path}: [split] must be a table")
    found: dict[str, tuple[int, int] | Path] = {}
    initialization: int | None = None
    for key, v in value.items():
        at = f"{path}: [split] {key}"
        if key == "initialization":
            if isinstance(v, bool) or not isinstance(v, int) or not 0 <= v < n:
                raise RecordingError(f"{at} must be a number of samples below {n}, got {v!r}")
            initialization = v
        elif isinstance(v, str) and re.search(r"\.toml$", v):
            found[key] = path_inside(path, v)
        elif isinstance(v, list) and len(v) == 2 and all(isinstance(i, int) and not isinstance(i, bool) for i in v):
            if not 0 <= v[0] < v[1] <= n:
                raise RecordingError(f"{at}: [{v[0]}, {v[1]}] does not lie in the {n} samples of the recording")
            found[key] = (v[0], v[1])
        else:
            raise RecordingError(f"{at} must be [start, stop] in samples or the name of another .toml, got {v!r}")
    _enough(path, found, initialization or 0)
    others = {k: v for k, v in found.items() if k not in ("fit", "test")}
    return Split(found.get("fit"), found.get("test"), others, initialization)
