"""Guesses what the columns of a data file are: time, input, output or context, signal and unit, and the kind of twin.

A guess is a proposal that a person corrects. Units are read from the names of columns (``force_N``, ``x [mm]``), roles
from names and units. ``python -m tools.mismatch.guess FILE`` prints the guess as JSON; ``--check RECORDING`` loads a
descriptor as ``micron mismatch diagnose`` would and prints nothing where it is good.
"""

from __future__ import annotations

import argparse
import json
import re
import sys
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np

from tools.errors import InputError
from tools.mismatch import units
from tools.mismatch.recording import RecordingError
from tools.mismatch.recording_columns import Array, column_names, read_columns
from tools.mismatch.recording_load import MIN_SAMPLES
from tools.mismatch.twins.vocabulary import CONTEXT_UNITS, KINDS

GuessedRole = Literal["time", "input", "output", "context", ""]
POINTS = 240
"""Smallest and largest values of so many parts of each column are returned, for drawing."""
MOST_COLUMNS = 200
_SUFFIX = re.compile(
    r"^(?P<name>.*?)(?:\s*[\[(](?P<inside>[^\[\]()]+)[\])]|[_ /](?P<after>[^_ /\[\]()]+(?:/[^_ ]+)?))$"
)
_TIME = re.compile(r"^(t|time|timestamp|seconds|sec|zeit)$", re.IGNORECASE)
_WORDS: tuple[tuple[GuessedRole, str], ...] = (
    ("context", r"temp|supply|ambient|humid|status|flag|state"),
    ("output", r"pos|disp|stroke|angle|vel|speed|meas|out|sensor|response|level|height|accel|volt"),
    ("input", r"command|cmd|input|drive|force|torque|current|set|demand|reference|excit|field|specific|u$"),
)
_BY_UNIT: tuple[tuple[GuessedRole, str], ...] = (
    ("context", "degC"), ("input", "N"), ("input", "N m"), ("output", "m"), ("output", "m/s"), ("output", "rad"),
    ("output", "rad/s"), ("output", "m/s^2"), ("input", "V"), ("input", "A"),
)  # fmt: skip


@dataclass(frozen=True)
class GuessedColumn:
    """One column. ``unit`` is empty where the name tells none; ``low`` and ``high`` are for drawing, [<= POINTS]."""

    name: str
    role: GuessedRole
    signal: str
    unit: str
    low: list[float]
    high: list[float]


@dataclass(frozen=True)
class Guess:
    """``time_column`` is empty without one; ``rate_hz`` is then None, too. ``kind`` is empty where none fits."""

    samples: int
    time_column: str
    rate_hz: float | None
    kind: str
    columns: list[GuessedColumn]


def split_unit(name: str) -> tuple[str, str]:
    """Return the name without its unit, and the unit; the unit is empty where the name ends in none."""
    found = _SUFFIX.match(name.strip())
    if found is None:
        return name.strip(), ""
    unit = found["inside"] or found["after"]
    try:
        units.parse(unit)
    except units.UnitError:
        return name.strip(), ""
    if not found["inside"] and unit.isdigit():
        return name.strip(), ""
    return found["name"].strip(), unit


def guess_role(name: str, unit: str) -> GuessedRole:
    """Return the role that a name, or else a unit, suggests; empty for no idea."""
    for role, pattern in _WORDS:
        if re.search(pattern, name, re.IGNORECASE):
            return role
    for role, of in _BY_UNIT:
        if unit and units.same_dimension(unit, of):
            return role
    return ""


def guess(path: Path) -> Guess:
    """Read a data file and propose what its columns are. Raises RecordingError."""
    names = column_names(path)
    if not names:
        raise RecordingError(f"{path}: no columns of numbers; a csv needs one header row, an npz one array per column")
    if len(names) > MOST_COLUMNS:
        raise RecordingError(f"{path}: {len(names)} columns; at most {MOST_COLUMNS} are looked at, keep those you need")
    columns = read_columns(path, names)
    n = next(iter(columns.values())).size
    if n < 2:
        raise RecordingError(f"{path}: {n} samples; a recording needs at least {MIN_SAMPLES}")
    parts = {name: split_unit(name) for name in names}
    clock = next((name for name in names if _is_time(columns[name], *parts[name])), "")
    roles: dict[str, GuessedRole] = {k: "time" if k == clock else guess_role(*parts[k]) for k in names}
    left = [k for k in names if not roles[k]]
    for name in left:  # without any idea: the first drives, the others answer
        roles[name] = "input" if "input" not in roles.values() else "output"
    rate_hz = None
    if clock and n > 2:
        step_s = float(np.median(np.diff(columns[clock]))) * units.parse(parts[clock][1] or "s").factor
        rate_hz = 1.0 / step_s if step_s > 0 else None
    kind = _guess_kind(roles, {k: parts[k][1] for k in names})
    found = [
        GuessedColumn(k, roles[k], _signal(k, parts[k], roles[k], kind), parts[k][1], *_extremes(columns[k]))
        for k in names
    ]
    return Guess(n, clock, rate_hz, kind, found)


def _is_time(values: Array, name: str, unit: str) -> bool:
    seconds = unit != "" and units.same_dimension(unit, "s")
    return bool((_TIME.match(name) or (seconds and name == "")) and values.size > 1 and (np.diff(values) > 0).all())


def _guess_kind(roles: dict[str, GuessedRole], unit_of: dict[str, str]) -> str:
    """Return the kind whose vocabulary takes the unit of every input and output; empty for none or no units."""
    wanted = [(role, unit_of[k]) for k, role in roles.items() if role in ("input", "output")]
    if not all(unit for _, unit in wanted):
        return ""
    for kind, words in KINDS.items():
        if words.open_ended:
            continue
        of = {"input": words.inputs, "output": words.outputs}
        fits = all(any(units.same_dimension(unit, u) for _, known in of[role] for u in known) for role, unit in wanted)
        if fits and {role for role, _ in wanted} == {"input", "output"}:
            return kind
    return ""


def _signal(name: str, parts: tuple[str, str], role: GuessedRole, kind: str) -> str:
    """Return the twin's own word for a column, else the column's name as a word."""
    plain, unit = parts
    own = re.sub(r"\W+", "_", plain).strip("_") or "signal"
    if role == "context":
        return next((s for s in CONTEXT_UNITS if s[:4] in plain.lower()), own)
    words = KINDS.get(kind)
    for pattern, known in (words.inputs if role == "input" else words.outputs) if words else ():
        if re.fullmatch(pattern, own):
            return own
        if unit and any(units.same_dimension(unit, u) for u in known):
            axis = plain[-1:].lower()
            if pattern.endswith("[xyz]"):
                return (
                    f"{pattern.removesuffix('[xyz]')}{axis if axis in 'xyz' else 'x'}" if "\\" not in pattern else own
                )
            return pattern
    return own


def _extremes(values: Array) -> tuple[list[float], list[float]]:
    if not values.size:
        return [], []
    starts = np.unique(np.linspace(0, values.size, POINTS, endpoint=False).astype(int))
    finite = np.where(np.isfinite(values), values, np.nan)
    low, high = np.fmin.reduceat(finite, starts), np.fmax.reduceat(finite, starts)
    return np.nan_to_num(low).tolist(), np.nan_to_num(high).tolist()


def as_json(found: Guess) -> dict[str, Any]:
    """Return a guess as JSON values."""
    return asdict(found)


def main(arguments: Sequence[str] | None = None) -> int:
    """Print a guess, or check a descriptor; exit status 2 with one message where that cannot be."""
    parser = argparse.ArgumentParser(prog="python -m tools.mismatch.guess")
    parser.add_argument("file", type=Path)
    parser.add_argument("--check", action="store_true", help="load a descriptor instead")
    options = parser.parse_args(arguments)
    try:
        if options.check:
            from tools.mismatch.recording_load import load

            load(options.file)
        else:
            print(json.dumps(as_json(guess(options.file))))
    except InputError as error:
        print(error, file=sys.stderr)
        return 2
    return 0


if __name__ == "__main__":
    sys.exit(main())
