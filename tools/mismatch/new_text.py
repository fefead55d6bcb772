"""Writes the text of a ``recording.toml`` from a guess: known facts as keys, unknown ones as comments."""

from __future__ import annotations

import json
import textwrap
from collections.abc import Iterator

from tools.mismatch.cut import Stretch
from tools.mismatch.guess import Guess, GuessedColumn
from tools.mismatch.key_tables import of_kind
from tools.mismatch.keys import Key
from tools.mismatch.twins.vocabulary import KINDS

WIDTH = 110


def recording_text(found: Guess, source: str, data: str, stretch: Stretch | None = None) -> str:
    """Return the descriptor of ``data``, guessed from the file ``source``; ``stretch``: what was cut or resampled."""
    return "\n".join(_lines(found, source, data, stretch)) + "\n"


def _lines(found: Guess, source: str, data: str, stretch: Stretch | None) -> Iterator[str]:
    yield f"# Guessed by 'micron mismatch new' from {source}; correct what is wrong. Keys: docs/own-data.md"
    remarks = {"Could not be known": found.unknown, "Assumed, because nothing tells it": found.assumed}
    for heading, items in {**remarks, "Notes": found.notes}.items():
        if items:
            yield f"# {heading}:"
            for one in items:
                yield from textwrap.wrap(one, WIDTH, initial_indent="# - ", subsequent_indent="#   ")
    yield "format = 1"
    yield f"title = {json.dumps(source)}"
    yield f"data = {json.dumps(data)}"
    yield from _clock(found, stretch)
    yield ""
    yield "[twin]"
    yield f"kind = {json.dumps(found.kind)}" if found.kind else f'# kind = "" # unknown; one of {", ".join(KINDS)}'
    tables = () if found.kind != "ode" else ("states", "equations", "outputs", "function", "units")
    if tables:
        yield from _equations(found)
    yield "[twin.parameters] # what you believe today"
    for key in of_kind(found.kind) if found.kind else ():
        if key.name.isidentifier() and key.name not in tables:
            yield _parameter(key)
    for column in found.columns:
        if column.role in ("input", "output", "context"):
            yield from _channel(column, found.kind)


def _clock(found: Guess, stretch: Stretch | None) -> Iterator[str]:
    if stretch is not None:
        yield f"rate_hz = {stretch.rate_hz!r} # brought to even steps; {stretch.filled} samples are filled in"
        if stretch.segments:
            yield f"segments = {list(stretch.segments)} # samples at which the {stretch.kept - 1} later runs begin"
    elif found.time_column:
        yield f"time_column = {json.dumps(found.time_column)} # about {found.rate_hz:.6g} Hz"
    elif found.rate_hz is not None:
        yield f"rate_hz = {found.rate_hz!r}"
    else:
        yield "# rate_hz = # unknown: samples per second"


def _equations(found: Guess) -> Iterator[str]:
    """Yield the tables of differential equations, with an example in the names of the columns."""
    drive, answer = (next(c for c in found.columns if c.role == role) for role in ("input", "output"))
    yield '# function = "FILE.py:NAME" # derivatives(t, states, inputs, parameters), in place of [twin.equations]'
    yield "[twin.states] # each state with its unit, or with a table of unit, start, min and max"
    yield f"# {answer.signal} = {json.dumps(answer.unit, ensure_ascii=False)}"
    yield "[twin.equations] # the derivative of each state"
    yield f'# {answer.signal} = "(gain * {drive.signal} - {answer.signal}) / time_constant" # an example'
    yield "[twin.outputs] # outputs that are no state; alone, without states and equations, they are a curve"
    yield "[twin.units] # units of parameters; of an input or output where the equations want another than the column's"


def _parameter(key: Key) -> str:
    absent = f"; if left out: {key.default}" if key.default else ""
    return f"# {key.name} = # {'' if key.default else 'needed: '}{key.value}: {key.help}{absent}"


def _channel(column: GuessedColumn, kind: str) -> Iterator[str]:
    yield ""
    yield "[[channels]]"
    yield f"column = {json.dumps(column.name, ensure_ascii=False)}"
    yield f'role = "{column.role}"'
    yield f"signal = {json.dumps(column.signal, ensure_ascii=False)}"
    if column.unit:
        yield f"unit = {json.dumps(column.unit, ensure_ascii=False)}"
    else:
        yield "# unit = # unknown" + (f"; the {kind}'s own is assumed" if kind else "")
    if column.role == "output":
        yield "# noise_rms = # of your instrument, in this unit, if you know it: a wrong one misleads the verdict"
