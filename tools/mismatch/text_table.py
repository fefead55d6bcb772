"""Reads tables of numbers in text files: any delimiter, decimal comma or point, optional header and row of units.

Dates with a time of day as ISO 8601 writes them are seconds since 1970; the time may stand in the next column.

The form is found from the first part of the file. Rows are read in blocks, so that a file may be larger than memory.
"""

from __future__ import annotations

import csv
import itertools
import re
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path
from typing import TextIO

import numpy as np

from hal.arrays import Array
from tools.errors import RecordingError, missing_column
from tools.mismatch import units

SUFFIXES = (".csv", ".tsv", ".txt")
HEAD_BYTES = 1 << 20
HEAD_LINES = 200
BLOCK_ROWS = 1 << 16
MISSING = frozenset(("", "nan", "na", "n/a", "-", "--", "null", "none"))
"""Cells, in lower case, that stand for a missing value."""
_NUMBER = re.compile(r"[+-]?(\d+\.?\d*|\.\d+)([eE][+-]?\d+)?|[+-]?(nan|inf|infinity)", re.IGNORECASE)
_CONTROL = re.compile(rb"[\x00-\x08\x0e-\x1a\x1c-\x1f]")
_COMMENT = ("#", "%")
A_DATE = "2026-03-10 18:00:00"
"""A date as it is read."""
_DAY, TIME_OF_DAY = r"\d{4}-\d\d-\d\d", r"\d\d:\d\d(:\d\d(\.\d+)?)?(Z|[+-]\d\d:?\d\d)?"
_DATE = re.compile(f"{_DAY}[T ]{TIME_OF_DAY}")


@dataclass(frozen=True)
class TextTable:
    """Describes the form of a table of numbers in a text file.

    ``delimiter``: None stands for blanks. ``names``: one per column, ``column_1`` and so on without a header.
    ``units``: from a row of units below the header, else empty. ``text``: columns that hold words instead of numbers,
    with the first of them; ``dates``: columns of dates. ``first``: the line of the first sample, counted from 1;
    ``samples``: whether it is there.
    """

    path: Path
    encoding: str
    delimiter: str | None
    decimal: str
    names: tuple[str, ...]
    units: tuple[str, ...]
    text: tuple[tuple[str, str], ...]
    dates: tuple[str, ...]
    first: int
    samples: bool

    @property
    def columns(self) -> list[str]:
        """Return the columns of numbers."""
        words = {name for name, _ in self.text}
        return [name for name in self.names if name not in words]

    def blocks(self, names: list[str], rows: int = BLOCK_ROWS) -> Iterator[Array]:
        """Yield the named columns as arrays of at most ``rows`` lines, (rows, names). Missing values are NaN.

        Raises RecordingError with the line and the column of a cell that is not a number.
        """
        for name in names:
            if name not in self.names:
                raise missing_column(self.path, name, list(self.names))
            if self.names.count(name) > 1:
                raise RecordingError(f"{self.path}: two columns are named '{name}'; rename one in the header")
        use = [self.names.index(name) for name in names]
        if not self.samples:
            raise RecordingError(f"{self.path}: no line of numbers below the header; is the file complete?")
        with _opened(self.path, self.encoding) as file:
            for _ in itertools.islice(file, self.first - 1):
                pass
            line = self.first
            while part := list(itertools.islice(file, rows)):
                numbered = [(line + i, text) for i, text in enumerate(part) if text.strip()]
                line += len(part)
                if numbered:
                    yield self._numbers(numbered, use)

    def read(self, names: list[str]) -> dict[str, Array]:
        """Return the named columns, float64 (n,). Raises RecordingError."""
        parts = list(self.blocks(names))
        return {name: np.concatenate([p[:, i] for p in parts]) for i, name in enumerate(names)}

    def _numbers(self, numbered: list[tuple[int, str]], use: list[int]) -> Array:
        of_dates = [self.names[i] in self.dates for i in use]
        if any(of_dates):
            return self._with_dates(numbered, use, of_dates)
        lines = [text for _, text in numbered]
        if self.decimal == ",":
            lines = [text.replace(",", ".") for text in lines]
        try:
            return np.loadtxt(lines, np.float64, None, self.delimiter, usecols=use, ndmin=2, quotechar='"')
        except ValueError:
            return np.array([self._row(number, text, use) for number, text in numbered])

    def _with_dates(self, numbered: list[tuple[int, str]], use: list[int], of_dates: list[bool]) -> Array:
        """Return the values (rows, use), of which some are dates."""
        found = np.empty((len(numbered), len(use)))
        plain = [i for i, is_date in zip(use, of_dates, strict=True) if not is_date]
        if plain:
            found[:, ~np.array(of_dates)] = self._numbers(numbered, plain)
        for k in np.flatnonzero(of_dates):
            found[:, k] = [self._seconds(number, line, use[k]) for number, line in numbered]
        return found

    def _seconds(self, number: int, line: str, column: int) -> float:
        """Return the date in a line in seconds since 1970."""
        cell = _date(_cells(line, self.delimiter), column)
        if cell.lower() in MISSING:
            return float("nan")
        try:
            # a day without its time would be read as midnight
            found = datetime.fromisoformat(cell if _DATE.fullmatch(cell) else "")
        except ValueError:
            raise RecordingError(
                f"{self.path}: line {number}: column '{self.names[column]}': '{cell[:40]}' is no date like {A_DATE};"
                " correct the line"
            ) from None
        return (found if found.tzinfo else found.replace(tzinfo=UTC)).timestamp()

    def _row(self, number: int, line: str, use: list[int]) -> list[float]:
        cells = _cells(line, self.delimiter)
        if len(cells) <= max(use):
            raise RecordingError(
                f"{self.path}: line {number}: {len(cells)} values, the header names {len(self.names)};"
                " complete the line"
            )
        return [self._value(number, i, cells[i]) for i in use]

    def _value(self, number: int, column: int, cell: str) -> float:
        if cell.lower() in MISSING:
            return float("nan")
        try:
            return float(cell.replace(",", ".") if self.decimal == "," else cell)
        except ValueError:
            raise RecordingError(
                f"{self.path}: line {number}: column '{self.names[column]}': '{cell[:40]}' is not a number;"
                " correct the line, or leave the cell empty if the value is missing"
            ) from None


def text_table(path: Path) -> TextTable:
    """Find the form of a table. Raises RecordingError for a file that is no text or has no lines that fit together."""
    head, encoding, whole = _head(path)
    lines = [(i + 1, line) for i, line in enumerate(head.splitlines())]
    if not whole:
        lines = lines[:-1]
        if not lines:
            raise RecordingError(f"{path}: no line ends within the first {HEAD_BYTES >> 20} MiB; this is no table")
    lines = [(number, line) for number, line in lines if line.strip()][:HEAD_LINES]
    body = [line for _, line in lines if not line.lstrip().startswith(_COMMENT)]
    delimiter, decimal = _delimiters(body[-max(1, len(body) // 2) :]) if body else (",", ".")
    rows = [(number, _cells(line, delimiter), line) for number, line in lines]
    plain = [row for row in rows if not row[2].lstrip().startswith(_COMMENT)]
    if not plain:
        return TextTable(path, encoding, delimiter, decimal, (), (), (), (), 1, False)
    last = [cells for _, cells, _ in plain[-max(1, len(plain) // 2) :]]
    width = max({len(c) for c in last}, key=[len(c) for c in last].count)
    of_numbers = [sum(_is_number(c[i], decimal) for c in last if len(c) == width) > 0 for i in range(width)]
    begin = _first_row(plain, width, of_numbers, decimal)
    first = plain[begin][0] if begin < len(plain) else plain[-1][0] + 1
    above = [(cells, line) for number, cells, line in rows if number < first]
    names, row_of_units = _header(path, above, delimiter, width)
    names = names or [f"column_{i + 1}" for i in range(width)]
    empty = [not names[i] and not any(c[i] for c in last if len(c) > i) for i in range(len(names))]
    while names and empty[len(names) - 1]:  # lines that end with a delimiter
        names.pop()
    names = [name or f"column_{i + 1}" for i, name in enumerate(names)]
    row = plain[begin][1] if begin < len(plain) else []
    dates = tuple(
        name for i, name in enumerate(names)
        if any(of_numbers) and _DATE.fullmatch(_date(row, i))
    )  # fmt: skip
    words = [
        (name, row[i])
        for i, name in enumerate(names)
        if i < len(row) and any(of_numbers) and i < width and not of_numbers[i] and name not in dates
        and any(c[i].lower() not in MISSING for c in last if len(c) > i)
    ]  # fmt: skip
    given = (*row_of_units, *[""] * len(names))[: len(names)]
    column_units = tuple("s" if name in dates else unit for name, unit in zip(names, given, strict=True))
    samples = begin < len(plain)
    return TextTable(
        path, encoding, delimiter, decimal, tuple(names), column_units, tuple(words), dates, first, samples
    )


def _head(path: Path) -> tuple[str, str, bool]:
    """Return the beginning of the file as text, its encoding, and True if that is the whole file."""
    try:
        with path.open("rb") as file:
            raw = file.read(HEAD_BYTES)
            whole = not file.read(1)
    except OSError as error:
        raise RecordingError(f"{path}: cannot be read ({error.strerror})") from None
    if raw.startswith((b"\xff\xfe", b"\xfe\xff")) or _CONTROL.search(raw):
        raise RecordingError(f"{path}: not a UTF-8 text file (it holds control bytes); save it as UTF-8 csv")
    # a line or a character that the end of the part cuts is ignored
    usable = raw if whole else raw[: raw.rfind(b"\n") + 1]
    for encoding in ("utf-8-sig", "cp1252"):
        try:
            return (usable.decode(encoding) + ("" if whole else "\n"), encoding, whole)
        except UnicodeDecodeError as error:
            reason = error.reason
    raise RecordingError(f"{path}: not a UTF-8 text file ({reason}); save it as UTF-8 csv")


@contextmanager
def _opened(path: Path, encoding: str) -> Iterator[TextIO]:
    try:
        with path.open(encoding=encoding) as file:
            yield file
    except UnicodeDecodeError as error:
        raise RecordingError(f"{path}: not a UTF-8 text file ({error.reason}); save it as UTF-8 csv") from None
    except OSError as error:
        raise RecordingError(f"{path}: cannot be read ({error.strerror})") from None


def _cells(line: str, delimiter: str | None) -> list[str]:
    line = line.strip("\r\n")
    if delimiter is None:
        return line.split()
    if '"' not in line:
        return [cell.strip() for cell in line.split(delimiter)]
    try:
        return [cell.strip() for cell in next(csv.reader([line], delimiter=delimiter, skipinitialspace=True), [])]
    except csv.Error:
        return [cell.strip() for cell in line.split(delimiter)]


def _date(cells: list[str], column: int) -> str:
    """Return the date in ``column``; where it is a day alone, with the time of day from the next column."""
    cell, after = (cells[i] if i < len(cells) else "" for i in (column, column + 1))
    return f"{cell} {after}" if re.fullmatch(_DAY, cell) and re.fullmatch(TIME_OF_DAY, after) else cell


def _is_number(cell: str, decimal: str) -> bool:
    return _NUMBER.fullmatch(cell.replace(",", ".") if decimal == "," else cell) is not None


def _delimiters(lines: list[str]) -> tuple[str | None, str]:
    """Return the delimiter that every line has, and the decimal sign; a comma may be either."""
    for sign in "\t;|":
        if all(sign in line for line in lines):
            cells = [cell for line in lines for cell in _cells(line, sign)]
            comma = sum("," in cell and _is_number(cell, ",") for cell in cells)
            point = sum("." in cell and _is_number(cell, ".") for cell in cells)
            return sign, "," if comma > point else "."
    best: tuple[float, int, str | None, str] = (-1.0, 0, ",", ".")
    forms: tuple[tuple[str | None, str], ...] = ((",", "."), (None, "."), (None, ","))
    for sign, decimal in forms:
        cells = [cell for line in lines for cell in _cells(line, sign)]
        share = sum(_is_number(cell, decimal) for cell in cells) / max(1, len(cells))
        if (share, len(cells)) > best[:2]:
            best = (share, len(cells), sign, decimal)
    return best[2:]


def _first_row(rows: list[tuple[int, list[str], str]], width: int, of_numbers: list[bool], decimal: str) -> int:
    """Return the index of the first line of samples: every line from there on has numbers in the number columns."""

    def has_number(cells: list[str]) -> bool:
        return any(_is_number(cell, decimal) for cell, number in zip(cells, of_numbers, strict=False) if number)

    def is_full(cells: list[str]) -> bool:
        return len(cells) == width and all(
            _is_number(cell, decimal) or cell.lower() in MISSING
            for cell, number in zip(cells, of_numbers, strict=True) if number
        )  # fmt: skip

    if not any(of_numbers):  # words alone: the first line is the header
        return 1
    found = next((k for k, (_, cells, _) in enumerate(rows) if is_full(cells) and has_number(cells)), len(rows))
    while found > 0 and len(rows[found - 1][1]) == width and has_number(rows[found - 1][1]):
        found -= 1
    return found


def _header(
    path: Path, above: list[tuple[list[str], str]], delimiter: str | None, width: int
) -> tuple[list[str], list[str]]:
    """Return the names and the units above the first line of samples; empty without any."""
    if not above:
        return [], []

    def parts(line: str) -> list[str]:
        line = line.strip()
        return _cells(line.lstrip("#%").strip() if line.startswith(_COMMENT) else line, delimiter)

    row_of_units: list[str] = []
    names = parts(above[-1][1])
    if len(above) == len(_TOA5) and parts(above[0][1])[0] == "TOA5":
        return parts(above[1][1]), parts(above[2][1])
    if len(above) > 1 and len(names) == width and len(parts(above[-2][1])) == width and _are_units(names):
        row_of_units = [cell.strip("[]() ") for cell in names]
        names = parts(above[-2][1])
    if delimiter is None and len(names) != width:  # names with blanks in them
        names = [cell for cell in re.split(r"\s{2,}|\t", above[-1][1].strip().lstrip("#% ")) if cell]
    if len(names) == width or (len(names) == width - 1 and delimiter is not None):
        return [*names, *[""] * (width - len(names))], row_of_units
    if above[-1][1].lstrip().startswith(_COMMENT) or len(names) < 2:
        return [], []
    return names, []


_TOA5 = ("environment", "names", "units", "processing")
"""Rows above the samples of a logger (Campbell Scientific, LoggerNet manual, appendix B, "TOA5")."""


def _are_units(cells: list[str]) -> bool:
    """Return True if a line is a row of units: each cell is a unit or empty, and at least one is a unit."""
    for cell in cells:
        try:
            units.parse(cell.strip("[]() "))
        except units.UnitError:
            return False
    return any(cells)
