"""Reads the table ``[[channels]]`` of a recording: columns, roles, signals, units, and what a twin takes of them."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import get_args

import numpy as np

from tools.errors import RecordingError, refuse_unknown_keys
from tools.mismatch import units
from tools.mismatch.recording import Array
from tools.mismatch.twins.vocabulary import Role, Vocabulary
from tools.numbers import is_finite_number

MOST_SIZE = 1e100  # of any value: squares must stay finite
KEYS = ("column", "role", "signal", "unit", "noise_rms", "resolution", "tolerance")
"""Keys of one of the ``[[channels]]``."""


@dataclass(frozen=True)
class Channel:
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


def read_channels(
    where: str, value: object, words: Vocabulary, kind: str, notes: list[str], in_file: Mapping[str, str]
) -> list[Channel]:
    if not isinstance(value, list) or not value:
        raise RecordingError(f"{where}: [[channels]] must be a list of tables")
    out: list[Channel] = []
    signals: dict[str, int] = {}
    columns: dict[str, int] = {}
    for i, entry in enumerate(value):
        at = f"{where}: [[channels]] {i + 1}"
        if not isinstance(entry, Mapping):
            raise RecordingError(f"{at}: must be a table")
        refuse_unknown_keys(f"{at}:", entry, KEYS)
        for key in ("column", "role", "signal"):
            if not isinstance(entry.get(key), str) or not entry[key]:
                raise RecordingError(f"{at}: '{key}' is missing or not a text")
        column, role, signal = entry["column"], entry["role"], entry["signal"]
        for key in ("column", "signal"):  # both stand in the text of exported programs
            if not entry[key].isprintable() or set(entry[key]) & {'"', "\\"}:
                raise RecordingError(f"{at}: '{key}' holds quotes, backslashes or unprintable characters; rename it")
        at += f" ('{column}')"
        if role not in get_args(Role):
            raise RecordingError(f"{at}: role must be input, output or context, got '{role}'")
        if signal in signals:
            raise RecordingError(
                f"{at}: signal '{signal}' is already taken by [[channels]] {signals[signal]}; one column per signal"
            )
        if column in columns:
            raise RecordingError(
                f"{at}: column '{column}' is already used by [[channels]] {columns[column]}; name another column"
            )
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
        out.append(Channel(column, role, signal, unit, to, noise, step, tolerance))
    if not any(c.role == "output" for c in out):
        raise RecordingError(
            f"{where}: no channel has role = 'output'; set it for the column that the twin is compared with"
        )
    if not any(c.role == "input" for c in out):
        raise RecordingError(f"{where}: no channel has role = 'input'; set it for the column that drives the twin")
    _together(where, kind, out)
    return out


def _positive(at: str, key: str, value: object) -> float | None:
    number = finite_number(at, key, value)
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
        here = f"; here SI or {', '.join(allowed)}" if allowed else ""
        raise RecordingError(f"{at}: {error}{here}") from None
    if not allowed:
        return value, value
    for to in allowed:
        if units.parse(to).dimension == parsed.dimension:
            return value, to
    raise RecordingError(f"{at}: unit '{value}' is not of the dimension of {' or '.join(allowed)}")


def _together(where: str, kind: str, channels: list[Channel]) -> None:
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
                raise RecordingError(
                    f"{where}: output '{o}' needs the input 'specific_force_{o[-1]}'; add it or drop {o}"
                )
    if kind == "mechanical_axis":
        if len(inputs) > 1:
            raise RecordingError(f"{where}: a mechanical_axis takes a force or a torque; drop one of the two inputs")
        angular = "torque" in inputs
        for o, c in outputs.items():
            if ("rad" in c.to) != angular:
                raise RecordingError(
                    f"{where}: output {o} in {c.to} does not go with the input {', '.join(inputs)};"
                    " a force moves metres, a torque radians"
                )


def converted(data_path: Path, c: Channel, column: Array, notes: list[str]) -> Array:
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


def refuse_equal_columns(path: Path, channels: list[Channel], columns: Mapping[str, Array], notes: list[str]) -> None:
    for i, a in enumerate(channels):
        for b in channels[:i]:
            if np.array_equal(columns[a.column], columns[b.column]) and np.ptp(columns[a.column]) > 0:
                if "output" in (a.role, b.role) and a.role != b.role:
                    raise RecordingError(
                        f"{path}: columns '{b.column}' ({b.role}) and '{a.column}' ({a.role}) hold the same numbers;"
                        " one of them is the wrong column"
                    )
                notes.append(f"columns '{b.column}' and '{a.column}' hold the same numbers")


def finite_number(where: str, key: str, value: object) -> float | None:
    if value is None:
        return None
    if not is_finite_number(value):
        raise RecordingError(f"{where}: {key} must be a finite number, got {value!r}")
    return float(value)
