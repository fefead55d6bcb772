"""Find the plugins of other installed packages: entry points by group, loaded when they are used.

A package declares ``[project.entry-points."micron.GROUP"]`` with ``name = "module:object"``; nothing here is edited.
Our own names come first: a package cannot replace what is built in.
"""

from __future__ import annotations

from collections.abc import Mapping
from importlib.metadata import EntryPoint, entry_points
from typing import TypeVar

from hal.errors import BenchError

DRIVERS = "micron.drivers"
DEVICES = "micron.devices"
ESTIMATORS = "micron.estimators"
EFFECTS = "micron.effects"
TWINS = "micron.twins"

_Kind = TypeVar("_Kind")


def offered(group: str) -> Mapping[str, EntryPoint]:
    """Entry points of ``group`` by name, not loaded. ``BenchError`` when two packages offer one name."""
    found: dict[str, EntryPoint] = {}
    for entry in entry_points(group=group):
        other = found.setdefault(entry.name, entry)
        if other.value != entry.value:
            raise BenchError(
                f"'{entry.name}' of {group} is offered twice ({other.value}, {entry.value}): uninstall one package"
            )
    return found


def load(group: str, name: str, kind: type[_Kind]) -> _Kind | None:
    """The object behind ``name``, which must be a ``kind``; ``None`` when nobody offers it.

    ``BenchError`` says what is wrong with the package.
    """
    entry = offered(group).get(name)
    if entry is None:
        return None
    try:
        thing = entry.load()
    except Exception as error:
        raise BenchError(f"'{name}' of {group} cannot be loaded from {entry.value}: {error!r}") from error
    if not isinstance(thing, kind):
        raise BenchError(f"'{name}' of {group}: {entry.value} is a {type(thing).__name__}, not a {kind.__name__}")
    return thing
