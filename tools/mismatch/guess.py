"""Guesses what the columns of a data file are: time, input, output or context, signal and unit, and the kind of twin.

A guess is a proposal that a person corrects; it lists what it could not know. Units are read from the names of columns
(``force_N``, ``x [mm]``) or a row of units, roles from names, values and units. The bench page and ``micron mismatch
new`` share it. ``python -m tools.mismatch.guess FILE`` prints the guess as JSON; ``--check RECORDING`` loads a
descriptor and builds its twin as ``micron mismatch diagnose`` would, and prints nothing where both are good.
"""

from __future__ import annotations

import argparse
import json
import re
import sys
from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np

from tools.errors import InputError, RecordingError
from tools.mismatch import units
from tools.mismatch.column_course import Course, course_of
from tools.mismatch.guess_roles import (
    Assignment,
    GuessedRole,
    Parts,
    assign,
    choose_kinds,
    roles_by_values,
    simulated_courses,
    simulated_unit,
    split_clock,
    split_unit,
    word,
)
from tools.mismatch.recording_columns import (
    Array,
    column_names,
    column_units,
    first_line,
    own_recording,
    read_blocks,
    read_scalars,
)
from tools.mismatch.recording_columns import word_columns as words_in
from tools.mismatch.recording_load import MIN_SAMPLES
from tools.mismatch.stamps import StampReader, Stamps
from tools.mismatch.text_table import A_DATE, BLOCK_ROWS, TIME_OF_DAY
from tools.mismatch.twins.vocabulary import KINDS, vocabulary

POINTS = 240
"""Number of parts of each column whose smallest and largest values are returned, for drawing."""
MOST_COLUMNS = 200
_PART = 256
"""Rows per part of a file that is longer than one block."""
_TIME = re.compile(r"^(t|time|time[ _-]?stamps?|seconds|secs?|zeit|elapsed([ _-]?time)?|.*log_time)$", re.IGNORECASE)
_NUMBER = re.compile(
    r"^(i|k|n|index|idx|samples?|sample[ _]?(no|number|index)|no|nr|row|count|record)\.?$", re.IGNORECASE
)
_RATE = re.compile(r"^(.*\.)?(fs|f_s|rate|sampl(e|ing)_?(rate|freq|frequency))(_?hz)?$", re.IGNORECASE)
_STEP = re.compile(r"^(.*\.)?(ts|t_s|dt|sampl(e|ing)_?(time|period))(_s)?$", re.IGNORECASE)
_LIKE_A_DATE = re.compile(r"^\d{1,4}[./:-]\d{1,2}[./:-]\d{1,4}\b")
_MARKS = (-200.0, -99.0, -999.0, -9999.0, 999.0, 9999.0, 99999.0, -32768.0, 32767.0, 65535.0)
"""Numbers that files write where a value is missing."""
_UNNAMED = re.compile(r"^column_\d+$")


@dataclass(frozen=True)
class GuessedColumn:
    """Describes a column. ``unit`` is empty if unknown; ``low`` and ``high``, at most POINTS values, are for drawing.

    ``missing`` counts values that are not finite; ``first_missing`` is the sample of the first of them, or -1.
    """

    name: str
    role: GuessedRole
    signal: str
    unit: str
    low: list[float]
    high: list[float]
    missing: int = 0
    first_missing: int = -1


@dataclass(frozen=True)
class Guess:
    """Proposes a recording.

    ``time_column`` is empty without one, or where ``rate_hz`` stands for it; ``rate_hz`` is None if unknown. ``kind``
    is empty if no twin fits. ``unknown`` lists what a person must supply before a diagnosis, ``broken`` what must be
    repaired first, ``assumed`` the assumptions that nothing confirms, ``notes`` the omissions with reasons. ``clock``
    is the column of time in any unit, ``clock_unit``; ``row_of_first`` is the line of the first sample of a text file,
    or 0.
    """

    samples: int
    time_column: str
    rate_hz: float | None
    kind: str
    columns: list[GuessedColumn]
    unknown: list[str]
    broken: list[str]
    assumed: list[str]
    notes: list[str]
    clock: str = ""
    clock_unit: str = "s"
    row_of_first: int = 0


@dataclass
class _Column:
    """Collects statistics of a column over blocks."""

    low: list[Array] = field(default_factory=list[Array])
    high: list[Array] = field(default_factory=list[Array])
    missing: int = 0
    first_missing: int = -1
    smallest: float = float("inf")
    largest: float = float("-inf")
    course: Course = ""
    """The course in the first block in which the values change."""
    marks: dict[float, int] = field(default_factory=dict[float, int])
    """How often each of ``_MARKS`` stands in the column, and the range of its other values."""
    inner_low: float = float("inf")
    inner_high: float = float("-inf")

    def add(self, values: Array, at: int, parts: int) -> None:
        finite = np.isfinite(values)
        if not finite.all():
            if self.first_missing < 0:
                self.first_missing = at + int(np.argmin(finite))
            self.missing += int(values.size - finite.sum())
        low, high = extremes(values, parts)
        if not self.smallest < self.largest:
            self.course = course_of(values)
        self.low.append(low)
        self.high.append(high)
        is_mark = np.isin(values, _MARKS)
        for mark in _MARKS if is_mark.any() else ():
            self.marks[mark] = self.marks.get(mark, 0) + int(np.sum(values == mark))
        inner = values[finite & ~is_mark]
        self.inner_low = min(self.inner_low, float(np.min(inner, initial=np.inf)))
        self.inner_high = max(self.inner_high, float(np.max(inner, initial=-np.inf)))
        self.smallest = min(self.smallest, float(np.nanmin(low, initial=np.inf)))
        self.largest = max(self.largest, float(np.nanmax(high, initial=-np.inf)))

    def mark(self) -> float | None:
        """Return the number that seems to mark missing values: repeated, and farther off than the others reach."""
        width = self.inner_high - self.inner_low
        return next(
            (
                m for m, count in self.marks.items()
                if count > 1 and width > 0.0 and max(self.inner_low - m, m - self.inner_high) > width
            ),
            None,
        )  # fmt: skip


def _of_words(name: str, first: str) -> str:
    """Return the note on a column without numbers whose first cell is ``first``."""
    if re.fullmatch(TIME_OF_DAY, first):
        return f"column '{name}' holds the time of day: it is read if the day stands in the column before it"
    found = f"column '{name}' is not used: it holds words ('{first}')"
    return f"{found}; a date is read as {A_DATE}" if _LIKE_A_DATE.match(first) else found


def guess(path: Path, kind: str = "") -> Guess:
    """Read a data file in blocks and propose what its columns are; ``kind`` is the twin where a person named one.

    Raises RecordingError.
    """
    names = _names(path)
    file_units = column_units(path)
    parts = {k: (k, file_units[k]) if units.is_unit(file_units.get(k)) else _split(k) for k in names}
    twice = [k for k in dict.fromkeys(names) if names.count(k) > 1]
    names = [k for k in names if k not in twice]
    notes = [f"column '{k}' is not used: more than one has this name" for k in twice]
    notes += [_of_words(name, first) for name, first in words_in(path)]
    unknown_units = {k: u for k, u in file_units.items() if u and not units.is_unit(u)}
    notes += [f"column '{k}': its unit '{u}' in the file is not known" for k, u in unknown_units.items()]
    row = first_line(path)
    seen, stamps, clock, n, assumed = _scan(path, names, parts, row)
    if n < 2:
        raise RecordingError(f"{path}: {n} samples; a recording needs at least {MIN_SAMPLES}")
    notes += [
        f"column '{k}' is {mark:g} in {c.marks[mark]} samples, far from its other values; if that marks a missing one,"
        " leave those cells empty"
        for k, c in seen.items()
        if (mark := c.mark()) is not None
    ]
    left = _candidates(names, parts, seen, clock, n, notes)
    if len(left) < 2:
        remarks = f" ({'; '.join(notes)})" if notes else ""
        raise RecordingError(
            f"{path}: columns of numbers beside the time: {len(left)}; a recording needs one that drives and one that"
            f" answers{remarks}"
        )
    given = kind
    by_values = roles_by_values({k: seen[k].course for k in left}, parts)
    pairs = {k: of for k, of in simulated_courses(left, parts).items() if of}
    kinds = [kind] if kind else ["columns"] if pairs else choose_kinds(left, parts, by_values)
    kind = kinds[0] if len(kinds) == 1 else ""
    if kind == "columns":  # the unit of a simulated course is that of its output, where its name has none
        parts |= {k: (parts[k][0], simulated_unit(k, parts) or parts[of][1]) for k, of in pairs.items()}
    found = assign(kind, left, parts, by_values)
    if found is None and given and not _is_open(given):
        raise RecordingError(f"{path}: no columns are an input and an output of a {given}; {_words_of(given)}")
    if found is None:
        raise RecordingError(
            f"{path}: no column tells by name or unit that it drives or answers: {', '.join(left)}; begin the name of"
            " one with 'input' and of another with 'output'"
        )
    notes += found.notes
    assumed += found.assumed
    unknown = [] if kind else [_no_kind(kinds, left, parts, found)]
    if kind == "columns":
        outputs = [found.signals[k] for k in left if found.roles[k] == "output"]
        unknown += [
            f'the simulated course of output \'{o}\': its column needs role = "input" and signal = "simulated_{o}"'
            for o in outputs
            if f"simulated_{o}" not in found.signals.values()
        ]
    if kind == "columns" and not given:
        courses = ", ".join(f"'{k}' is the simulated course of '{of}'" for k, of in pairs.items())
        assumed.append(f"the kind of twin is columns, because {courses}; for another repeat with --twin KIND")
    elif kind and not given and not any(word(parts[k][0]) == found.signals.get(k) for k in left):
        assumed.append(f"the kind of twin is {kind}, by its units alone; for another repeat with --twin KIND")
    bare = [k for k in left if found.roles[k] in ("input", "output") and not parts[k][1]]
    if bare:
        assumed.append("units: " + ", ".join(f"'{k}' in {_assumed_unit(kind, found, k) or '1'}" for k in bare))
    columns = [
        GuessedColumn(
            k,
            found.roles.get(k, ""),
            found.signals.get(k, ""),
            parts[k][1],
            *_drawn(seen[k]),
            seen[k].missing,
            seen[k].first_missing,
        )
        for k in names
    ]
    broken = [
        f"column '{k}' has {seen[k].missing} missing values, the first at {place(seen[k].first_missing, row)}"
        for k in left
        if found.roles[k] and seen[k].missing
    ]
    clock_unit = parts[clock][1] or "s" if clock else "s"
    if stamps is not None:
        time_column, rate_hz = _time_of(clock, clock_unit, stamps, broken, notes)
        assumed = [f"{text}{_consequence(n, rate_hz)}" if is_assumed_clock(text, clock) else text for text in assumed]
    else:
        constants = {k: c.smallest for k, c in seen.items() if c.smallest == c.largest}
        time_column, rate_hz = clock, _rate_beside({**constants, **read_scalars(path)}, notes)
        if rate_hz is None:
            unknown.append("the rate: no column is a time that runs forwards; set rate_hz, or repeat with --rate HZ")
    as_clock = {"role": "time" if clock == time_column else "", "signal": found.signals.get(clock, "t")}
    columns = [replace(c, **as_clock) if c.name == clock else c for c in columns]
    return Guess(n, time_column, rate_hz, kind, columns, unknown, broken, assumed, notes, clock, clock_unit, row)


def _names(path: Path) -> list[str]:
    """Return the names of the columns of numbers. Raises RecordingError for a file that cannot be described."""
    if own_recording(path) is not None:
        raise RecordingError(
            f"{path}: a recording of micron run; 'micron export {path} FOLDER' writes it with its twin and bench"
        )
    names = column_names(path)
    if not names:
        raise RecordingError(
            f"{path}: no columns of numbers; a csv needs lines of numbers, an npz one array per column"
        )
    if len(names) > MOST_COLUMNS:
        raise RecordingError(f"{path}: {len(names)} columns; at most {MOST_COLUMNS} are looked at, keep those you need")
    return names


def _time_of(clock: str, unit: str, stamps: Stamps, broken: list[str], notes: list[str]) -> tuple[str, float | None]:
    """Return the time column, empty where even steps in another unit than s become a rate, and the rate in Hz."""
    if not stamps.is_usable:
        broken.append(_broken_clock(clock, stamps))
    elif stamps.is_even and units.parse(unit).factor != 1.0:
        notes.append(f"column '{clock}' is the time in {unit}: its even steps are written as rate_hz")
        return "", stamps.rate_hz
    elif stamps.faults:
        notes.append(_broken_clock(clock, stamps) + ": short gaps, which are filled by straight lines")
    return clock, stamps.rate_hz


def place(sample: int, row_of_first: int) -> str:
    """Return where a sample is: its line in a text file, else its number."""
    return f"line {sample + row_of_first}" if row_of_first else f"sample {sample}"


def _scan(
    path: Path, names: list[str], parts: Parts, row: int
) -> tuple[dict[str, _Column], Stamps | None, str, int, list[str]]:
    """Read all blocks once; return statistics per column, time stamps, their column, sample count and assumptions."""
    seen = {name: _Column() for name in names}
    reader: StampReader | None = None
    clock, n = "", 0
    assumed: list[str] = []
    for block in _slices(path, names):
        size = block[names[0]].size
        if n == 0:
            clock, assumption = _find_clock(names, parts, block)
            if clock:
                reader = StampReader(row)
            if assumption:
                assumed.append(assumption)
        for name in names:
            seen[name].add(block[name], n, POINTS if n == 0 and size < BLOCK_ROWS else -(-size // _PART))
        if reader is not None:
            reader.add(block[clock] * units.parse(parts[clock][1] or "s").factor)
        n += size
    return seen, None if reader is None else reader.stamps(), clock, n, assumed


def _slices(path: Path, names: list[str]) -> Iterator[dict[str, Array]]:
    for block in read_blocks(path, names):
        size = block[names[0]].size
        for a in range(0, size, BLOCK_ROWS):
            yield {name: values[a : a + BLOCK_ROWS] for name, values in block.items()}


def _split(name: str) -> tuple[str, str]:
    """Return the name of a column without its unit, and the unit; ``t_min`` is in minutes, and ``x_min`` is not."""
    clock = split_clock(name)
    return clock if _TIME.match(clock[0]) else split_unit(name)


def _find_clock(names: Sequence[str], parts: Parts, head: dict[str, Array]) -> tuple[str, str]:
    """Find the column of time and the assumption behind the choice; both are empty without one."""
    for name in names:
        plain, unit = parts[name]
        seconds = unit != "" and units.same_dimension(unit, "s")
        if unit and not seconds:
            continue
        forward = _forward(head[name])
        if (_TIME.match(plain) and forward > 0.5) or (seconds and forward > 0.9):
            return name, "" if unit else f"the time in '{name}' is in s"
    first = names[0]
    if _UNNAMED.match(first) and _forward(head[first]) == 1.0:
        steps = np.diff(head[first])
        if np.ptp(steps) < 0.1 * np.median(steps) and not (np.median(steps) == 1.0 and np.ptp(steps) == 0.0):
            return first, f"'{first}' is the time in s, because it rises in even steps"
    return "", ""


def is_assumed_clock(text: str, clock: str) -> bool:
    """Return True if ``text`` is the assumption that the column ``clock`` is the time in s."""
    return text.startswith((f"the time in '{clock}' is in s", f"'{clock}' is the time in s"))


def _consequence(samples: int, rate_hz: float | None) -> str:
    """Return what a time in s says of the recording, for a person who knows better."""
    if rate_hz is None:
        return ""
    return (
        f": {rate_hz:.4g} samples per second, {(samples - 1) / rate_hz:.4g} s in all;"
        f" if it is in ms, repeat with --rate {1e3 * rate_hz:.6g}"
    )


def _forward(values: Array) -> float:
    """Return the share of steps that rise."""
    return float(np.mean(np.diff(values) > 0)) if values.size > 1 else 0.0


def _candidates(
    names: Sequence[str], parts: Parts, seen: dict[str, _Column], clock: str, n: int, notes: list[str]
) -> list[str]:
    """Return the columns that may have a role: neither counters of samples nor constants."""
    left: list[str] = []
    for name in names:
        column = seen[name]
        counts = column.missing == 0 and column.largest - column.smallest == n - 1 and (
            _NUMBER.match(parts[name][0]) or (_UNNAMED.match(name) and name == names[0])
        )  # fmt: skip
        if name == clock:
            continue
        if counts:
            notes.append(f"column '{name}' is not used: it counts the samples")
        elif not column.smallest < column.largest:
            notes.append(f"column '{name}' is not used: it never changes")
        else:
            left.append(name)
    return left


def _rate_beside(numbers: dict[str, float], notes: list[str]) -> float | None:
    """Find the rate among the single numbers of a file, by name."""
    for name, value in numbers.items():
        if value > 0 and (_RATE.match(name) or _STEP.match(name)):
            notes.append(f"'{name}' = {value:g} of the file is taken as the {'rate' if _RATE.match(name) else 'step'}")
            return value if _RATE.match(name) else 1.0 / value
    return None


def _broken_clock(clock: str, stamps: Stamps) -> str:
    more = f" and {stamps.faults - len(stamps.places)} more" if stamps.faults > len(stamps.places) else ""
    faults = "; ".join(stamps.places) or f"the stamps leave an even grid by {stamps.wander:.3g} steps"
    return f"the time in '{clock}' (usual step {stamps.step_s:.4g} s) is uneven: {faults}{more}"


def _no_kind(kinds: Sequence[str], left: Sequence[str], parts: Parts, found: Assignment) -> str:
    if kinds:
        return f"the twin: the columns fit a {' and a '.join(kinds)}; set its kind, or repeat with --twin KIND"
    by_role = {
        role: [parts[k][1] or f"'{k}' (no unit)" for k in left if found.roles[k] == role]
        for role in ("input", "output")
    }
    return (
        f"the twin: no kind is told by {', '.join(by_role['input'])} in and {', '.join(by_role['output'])} out;"
        " set its kind, or repeat with --twin ode (your equations as text, or a curve without states), --twin columns"
        " (the file holds simulated columns, too) or another KIND"
        f" ({', '.join(k for k in KINDS if k not in ('ode', 'columns'))})"
    )


def _is_open(kind: str) -> bool:
    words = vocabulary(kind)
    return words is None or words.open_ended


def _words_of(kind: str) -> str:
    words = KINDS[kind]
    return "; ".join(
        f"{role}s: " + ", ".join(f"{p} ({' or '.join(u)})" for p, u in known)
        for role, known in (("input", words.inputs), ("output", words.outputs))
    )


def _assumed_unit(kind: str, found: Assignment, name: str) -> str:
    words = vocabulary(kind) if kind else None
    role = found.roles[name]
    if words is None or role not in ("input", "output"):
        return ""
    return next(iter(words.units(role, found.signals[name]) or ()), "")


def _drawn(column: _Column) -> tuple[list[float], list[float]]:
    low, high = np.concatenate(column.low), np.concatenate(column.high)
    if low.size > POINTS:
        low, high = extremes(low, POINTS)[0], extremes(high, POINTS)[1]
    return np.nan_to_num(low).tolist(), np.nan_to_num(high).tolist()


def extremes(values: Array, parts: int) -> tuple[Array, Array]:
    """Return the smallest and the largest values of at most ``POINTS`` parts."""
    starts = np.unique(np.linspace(0, values.size, parts, endpoint=False).astype(int))
    finite = np.where(np.isfinite(values), values, np.nan)
    return np.fmin.reduceat(finite, starts), np.fmax.reduceat(finite, starts)


def as_json(found: Guess) -> dict[str, Any]:
    """Return a guess as JSON values."""
    return asdict(found)


_COSTLY = ("fmu", "instrument")
"""Kinds of twin that a check does not build: a program, and a whole bench."""


def main(arguments: Sequence[str] | None = None) -> int:
    """Print a guess, or check a descriptor; on failure exit with status 2 and a message."""
    parser = argparse.ArgumentParser(prog="python -m tools.mismatch.guess")
    parser.add_argument("file", type=Path)
    parser.add_argument("--check", action="store_true", help="load a descriptor instead")
    options = parser.parse_args(arguments)
    try:
        if options.check:
            from tools.mismatch.recording_load import load

            recording = load(options.file)
            if recording.twin.kind not in _COSTLY:
                from tools.mismatch.twins.make import make

                make(recording)
        else:
            print(json.dumps(as_json(guess(options.file))))
    except InputError as error:
        print(error, file=sys.stderr)
        return 2
    return 0


if __name__ == "__main__":
    sys.exit(main())
