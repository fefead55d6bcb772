"""Finds lazily loaded objects by name: built-in ones, those of folders, and those of installed packages (plugins).

A package declares ``[project.entry-points."micron.GROUP"]`` with ``name = "module:object"``; no file here changes.
Built-in names come first, so a package cannot replace them.
"""

from __future__ import annotations

import importlib
import pkgutil
from collections.abc import Mapping
from dataclasses import dataclass
from importlib.metadata import EntryPoint, entry_points
from pathlib import Path
from typing import Generic, TypeVar

from hal.errors import BenchError

DRIVERS = "micron.drivers"
DEVICES = "micron.devices"
ESTIMATORS = "micron.estimators"
FUSION = "micron.fusion"
ATTITUDE = "micron.attitude"
EFFECTS = "micron.effects"
TWINS = "micron.twins"

_Kind = TypeVar("_Kind")


def offered(group: str) -> Mapping[str, EntryPoint]:
    """Return the entry points of ``group`` by name, not loaded. Of a name that two packages offer, it holds one."""
    return {entry.name: entry for entry in entry_points(group=group)}


def find_entry(group: str, name: str) -> EntryPoint | None:
    """Return the entry point ``name`` of ``group``, not loaded, or ``None`` when no package offers it.

    Raises ``BenchError`` when two packages offer the name. Other names of the group do not matter."""
    entries = {entry.value: entry for entry in entry_points(group=group, name=name)}
    if len(entries) > 1:
        packages = " and ".join(f"{_package(entry)} ({value})" for value, entry in entries.items())
        raise BenchError(f"'{name}' of {group} is offered twice, by {packages}: uninstall one of the packages")
    return next(iter(entries.values()), None)


def _package(entry: EntryPoint) -> str:
    return entry.dist.name if entry.dist is not None else "an unnamed package"


def load(group: str, name: str, kind: type[_Kind]) -> _Kind | None:
    """Return the object behind ``name``, which must be a ``kind``, or ``None`` when no package offers it.

    Raises ``BenchError`` with the cause when the package is broken or another one offers the name, too.
    """
    entry = find_entry(group, name)
    return None if entry is None else _load(group, name, entry, kind)


def _load(group: str, name: str, entry: EntryPoint, kind: type[_Kind]) -> _Kind:
    try:
        thing = entry.load()
    except Exception as error:
        raise BenchError(f"'{name}' of {group} cannot be loaded from {entry.value}: {error!r}") from error
    if not isinstance(thing, kind):
        raise BenchError(f"'{name}' of {group}: {entry.value} is a {type(thing).__name__}, not a {kind.__name__}")
    return thing


@dataclass(frozen=True)
class Registry(Generic[_Kind]):
    """Finds objects of ``kind`` by name; each is imported when it is asked for.

    ``built_in`` maps names to ``module:object``. ``folder`` is ``package:module:object``: a folder NAME in the package
    that has this module is found as NAME. Entry points of ``group`` come last.
    """

    group: str
    kind: type[_Kind]
    built_in: Mapping[str, str]
    folder: str

    def targets(self) -> dict[str, str]:
        """Return ``module:object`` of every name, ours first."""
        ours = {**self.built_in, **self._folders()}
        others = {name: entry.value for name, entry in sorted(offered(self.group).items()) if name not in ours}
        return {**ours, **others}

    def find(self, name: str) -> _Kind | None:
        """Return the object ``name``, or ``None`` if there is none. ``BenchError`` says what is wrong with it."""
        target = self.built_in.get(name) or self._folders().get(name)
        if target is not None:
            return _load(self.group, name, EntryPoint(name, target, self.group), self.kind)
        return load(self.group, name, self.kind)

    def _folders(self) -> dict[str, str]:
        package, module, attribute = self.folder.split(":")
        targets: dict[str, str] = {}
        for info in pkgutil.iter_modules(importlib.import_module(package).__path__):
            path = getattr(info.module_finder, "path", None)
            if info.ispkg and path is not None and (Path(path) / info.name / f"{module}.py").is_file():
                targets[info.name] = f"{package}.{info.name}.{module}:{attribute}"
        return targets
