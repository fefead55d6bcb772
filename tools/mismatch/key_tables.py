"""Tabulates the keys of ``recording.toml`` and of twins, as the parsers know them.

A key without a description in ``keys`` is listed as well.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from importlib import import_module

from tools.mismatch import recording_channels, recording_load
from tools.mismatch.keys import CHANNEL, PARAMETERS, SPLIT, TOP, TWIN, Key, names


def tables() -> Iterator[tuple[str, Sequence[Key]]]:
    """Yield (heading, keys) of every table of ``recording.toml`` except the twins' parameters."""
    yield "Top of the file", listed(TOP, recording_load.TOP_KEYS)
    yield "`[[channels]]`", listed(CHANNEL, recording_channels.KEYS)
    yield "`[split]`", SPLIT
    yield "`[twin]`", TWIN


def of_kind(kind: str) -> Sequence[Key]:
    """Return the keys of ``[twin.parameters]`` of a kind of twin, as its own module knows them."""
    described = PARAMETERS.get(kind, ())
    module = {"state_space": "state_space", "mechanical_axis": "axis", "ode": "ode_text"}.get(kind)
    if module is None:
        return described
    code = import_module(f"tools.mismatch.twins.{module}")
    return listed(described, getattr(code, "TABLES" if kind == "ode" else "_NAMES"))


def listed(described: Sequence[Key], known: Iterable[str]) -> list[Key]:
    """Return the keys that a parser knows with their descriptions; keys without one come last."""
    known = list(known)
    rest = sorted(set(known) - set(names(described)))
    free = [k for k in described if not k.name.isidentifier()]
    return [*(k for k in described if k.name in known), *(Key(n, "", "not described yet", " ") for n in rest), *free]
