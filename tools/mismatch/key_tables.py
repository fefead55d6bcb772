"""The keys of ``recording.toml`` and of twins as tables: which there are is asked of the code that parses them.

A key that nobody has described in ``keys`` is listed all the same.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from importlib import import_module

from tools.mismatch import recording_load
from tools.mismatch.keys import CHANNEL, PARAMETERS, SPLIT, TOP, TWIN, Key, names


def tables() -> Iterator[tuple[str, Sequence[Key]]]:
    """(heading, keys) of every table of ``recording.toml`` but the twins' parameters."""
    yield "Top of the file", listed(TOP, recording_load._TOP)
    yield "`[[channels]]`", listed(CHANNEL, recording_load._CHANNEL)
    yield "`[split]`", SPLIT
    yield "`[twin]`", TWIN


def of_kind(kind: str) -> Sequence[Key]:
    """Keys of ``[twin.parameters]`` of one kind of twin, as its own module knows them."""
    described = PARAMETERS.get(kind, ())
    module = {"state_space": "state_space", "mechanical_axis": "axis", "ode": "ode_text"}.get(kind)
    if module is None:
        return described
    code = import_module(f"tools.mismatch.twins.{module}")
    return listed(described, getattr(code, "TABLES" if kind == "ode" else "_NAMES"))


def listed(described: Sequence[Key], known: Iterable[str]) -> list[Key]:
    """The keys that a parser knows, with what is said of them; the others of them at the end."""
    known = list(known)
    rest = sorted(set(known) - set(names(described)))
    free = [k for k in described if not k.name.isidentifier()]
    return [*(k for k in described if k.name in known), *(Key(n, "", "not described yet", " ") for n in rest), *free]
