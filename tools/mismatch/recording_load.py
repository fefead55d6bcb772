"""Loads a descriptor as a Recording (contract, section 1) and names every fault."""

from __future__ import annotations

import re
import tomllib
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from hal.trust import path_inside
from tools.errors import RecordingError, refuse_unknown_keys
from tools.mismatch.input_noise import conditional_mean
from tools.mismatch.recording import Array, Recording, TwinText
from tools.mismatch.recording_channels import Channel, converted, finite_number, read_channels, refuse_equal_columns
from tools.mismatch.recording_clock import CUT, in_seconds, on_grid, time_step
from tools.mismatch.recording_columns import SUFFIXES, column_names, column_units, read_columns
from tools.mismatch.recording_ranges import read_conditions, read_segments, read_split
from tools.mismatch.twins.vocabulary import KINDS, NO_STATE, Role, Vocabulary, user_kinds, vocabulary
from tools.numbers import is_finite_number

MIN_SAMPLES = 50
TOP_KEYS = (
    "format", "title", "data", "rate_hz", "time_column", "twin", "channels", "split", "segments", "conditions",
)  # fmt: skip
TWIN_KEYS = ("kind", "parameters", "effects", "file")
STANDS_STILL: Mapping[str, Any] = {"states": {NO_STATE: "1"}, "equations": {NO_STATE: f"-{NO_STATE}"}}
"""Equations of a curve, whose outputs follow the inputs at once: its one state stays at zero."""
"""Keys of ``[twin]`` for every kind; those of an ode's parameters may stand there, too."""


def load(path: Path | str, data: Path | None = None) -> Recording:
    """Load the recording of a descriptor (a folder with ``recording.toml``, or any ``.toml``), check and convert it.

    ``data``: another file with the same columns in place of the descriptor's own, as one run without a split. Raises
    RecordingError for any fault.
    """
    path = Path(path)
    if path.is_dir():
        path = path / "recording.toml"
    return from_table(path, _toml(path), data=data)


def from_table(
    path: Path, text: Mapping[str, Any], columns: Mapping[str, Array] | None = None, twin: TwinText | None = None,
    *, data: Path | None = None,
) -> Recording:  # fmt: skip
    """Build the recording that a descriptor's table describes, checked and converted. Messages name ``path``.

    If given, ``columns`` (n,) by name replace the data file, ``data`` is another one (``load``), and ``twin`` replaces
    the table ``[twin]``. Raises RecordingError for any fault.
    """
    where = str(path)
    if text.get("format") != 1:
        got = f"got {text['format']!r}" if "format" in text else "and the file has none"
        raise RecordingError(f"{where}: format must be 1, {got}; docs/own-data.md has every key")
    if "channels" not in text:
        raise RecordingError(f"{where}: no [[channels]]; describe each column that is used")
    data_name = text.get("data")
    if columns is None and not isinstance(data_name, str):
        raise RecordingError(f"{where}: 'data' must name the data file ({', '.join(SUFFIXES)}), got {data_name!r}")
    if twin is None:
        twin, words = _twin(where, _twin_table(path, text.get("twin")))
    else:
        words = Vocabulary(open_ended=True)
    refuse_unknown_keys(f"{where}:", text, TOP_KEYS)
    notes: list[str] = []
    if data is not None and text.get("segments"):
        notes.append(f"segments are those of {data_name}; {data} is one run")
    if data is not None:
        text = {key: value for key, value in text.items() if key not in ("split", "segments")}
    data_path = path if columns is not None else data or path_inside(path, str(data_name))
    in_file = column_units(data_path) if columns is None and data_path.is_file() else {}
    channels = read_channels(where, text["channels"], words, twin.kind, notes, in_file)
    if twin.kind == "ode":
        notes += _unused_names(twin.parameters, channels)
    rate, time_column = read_clock(where, text)
    names = [c.column for c in channels]
    if time_column is not None and time_column not in names:
        names.append(time_column)
    columns = read_columns(data_path, names) if columns is None else {name: columns[name] for name in names}
    _check_samples(data_path, columns)
    if time_column is not None:
        stamps = in_seconds(time_column, columns[time_column], in_file.get(time_column, ""), notes)
        dt, grid = time_step(data_path, time_column, stamps, rate, notes)
        if grid is not None:
            columns = {name: on_grid(grid, dt, stamps, x) for name, x in columns.items()}
    else:
        assert rate is not None
        dt, grid = 1.0 / rate, None
    n = columns[names[0]].size
    segments = read_segments(path, text.get("segments"), n, twin.kind, grid is not None)
    signals: dict[Role, dict[str, Array]] = {"input": {}, "output": {}, "context": {}}
    for c in channels:
        signals[c.role][c.signal] = converted(data_path, c, columns[c.column], notes)
    refuse_equal_columns(data_path, channels, columns, notes)
    recording = Recording(
        path=path,
        title=str(text.get("title", path.stem)),
        t=np.asarray(np.arange(n) * dt, np.float64),
        dt=dt,
        inputs=signals["input"],
        outputs=signals["output"],
        context=signals["context"],
        noise={c.signal: c.scaled(c.noise) for c in channels if c.role == "output"},
        unit={c.signal: c.to for c in channels},
        declared_unit={c.signal: c.unit for c in channels},
        column={c.signal: c.column for c in channels},
        twin=twin,
        split=read_split(path, text.get("split"), n),
        declared_step={c.signal: step for c in channels if (step := c.scaled(c.step)) is not None},
        tolerance={c.signal: most for c in channels if (most := c.scaled(c.tolerance)) is not None},
        warnings=tuple(notes),
        segments=segments,
        input_noise={c.signal: v for c in channels if c.role == "input" and (v := c.scaled(c.noise)) is not None},
        conditions=read_conditions(where, text.get("conditions")),
    )
    return _for_twin(_without_input_noise(recording), time_column)


def _without_input_noise(recording: Recording) -> Recording:
    """Replace each input whose noise is stated by its mean given the whole course."""
    expected = {
        signal: conditional_mean(recording.inputs[signal], noise, recording.segments)
        for signal, noise in recording.input_noise.items()
    }
    return replace(recording, inputs={**recording.inputs, **expected}) if expected else recording


def _for_twin(recording: Recording, time_column: str | None) -> Recording:
    """Return the recording in the units of its twin, with a note where its samples are too far apart for the twin."""
    if recording.twin.kind in ("state_space", "ode"):
        from tools.mismatch.recording_units import in_twin_units

        recording = in_twin_units(recording)
    if time_column is not None:
        from tools.mismatch.recording_pace import pace_note

        note = pace_note(recording, time_column)
        recording = replace(recording, warnings=(*recording.warnings, note)) if note else recording
    return recording


def _unused_names(table: Mapping[str, Any], channels: Sequence[Channel]) -> list[str]:
    """Return a note on each name of an ode's outputs, units and parameters that belongs to nothing."""

    def of(key: str) -> Mapping[str, Any]:
        value = table.get(key)
        return value if isinstance(value, Mapping) else {}

    outputs = {c.signal for c in channels if c.role == "output"}
    numbers = {k for k, v in table.items() if is_finite_number(v)}
    known = {c.signal for c in channels} | {f"{o}_offset" for o in outputs} | numbers
    notes = [f"[twin.outputs] {o}: no channel is this output; not used" for o in of("outputs") if o not in outputs]
    notes += [
        f"[twin.units] {n}: no signal or parameter has this name; not used" for n in of("units") if n not in known
    ]
    if "equations" in table:
        read = set(re.findall(r"[^\W\d]\w*", " ".join(map(str, (*of("equations").values(), *of("outputs").values())))))
        notes += [f"[twin.parameters] {n}: no equation has this name; not used" for n in table if n in numbers - read]
    return notes


def columns_left_out(path: Path) -> list[str]:
    """Return the columns of numbers in the data file of a descriptor that it does not name. Raises RecordingError."""
    path = path / "recording.toml" if path.is_dir() else path
    text = _toml(path)
    used = {text.get("time_column"), *(c["column"] for c in text["channels"])}
    return [name for name in column_names(path_inside(path, str(text["data"]))) if name not in used]


def read_clock(where: str, text: Mapping[str, Any]) -> tuple[float | None, str | None]:
    """Return the rate in Hz and the name of the time column; at least one of them is given."""
    rate, time_column = finite_number(where, "rate_hz", text.get("rate_hz")), text.get("time_column")
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


def descriptor(path: Path) -> dict[str, Any]:
    """Return the table of a descriptor, unchecked. Raises RecordingError if it does not exist or is not TOML."""
    return _toml(path)


def _toml(path: Path) -> dict[str, Any]:
    if not path.is_file():
        raise RecordingError(f"{path}: no such recording; give a folder with recording.toml or a .toml file")
    is_data = path.suffix.lower() in SUFFIXES
    advice = f"; 'micron mismatch new {path}' describes a data file in a recording.toml" if is_data else ""
    try:
        return tomllib.loads(path.read_text(encoding="utf-8-sig"))
    except OSError as error:
        raise RecordingError(f"{path}: cannot be read ({error.strerror}); give a file that you may read") from None
    except UnicodeDecodeError as error:
        raise RecordingError(f"{path}: not UTF-8 text ({error.reason}){advice or '; save it as UTF-8'}") from None
    except (ValueError, RecursionError) as error:  # of tomllib; numbers of thousands of digits; tables too deep
        raise RecordingError(f"{path}: not valid TOML: {error}{advice}") from None


def _twin_table(path: Path, value: object) -> object:
    """Return the [twin] table, or that of the twin file which it names."""
    if not isinstance(value, Mapping) or "file" not in value:
        return value
    name = value["file"]
    if not isinstance(name, str) or len(value) > 1:
        raise RecordingError(f"{path}: [twin] file must be the name of a twin file, and stand alone")
    other = path_inside(path, name)
    if not other.is_file():
        raise RecordingError(f"{path}: [twin] file: {other} does not exist; name it relative to the recording")
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
    beside = {k: v for k, v in value.items() if k not in TWIN_KEYS}
    for key in sorted(beside.keys() & parameters.keys()):
        raise RecordingError(f"{where}: '{key}' stands in [twin] and in [twin.parameters]; leave one of them out")
    parameters = {**parameters, **beside}
    if kind == "ode" and "outputs" in parameters and not {"states", "equations", "function"} & set(parameters):
        parameters |= STANDS_STILL
    if not isinstance(effects, list) or not all(isinstance(e, Mapping) for e in effects):
        raise RecordingError(f"{where}: [[twin.effects]] must be tables")
    return TwinText(kind, dict(parameters), tuple(effects)), words
