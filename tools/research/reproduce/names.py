"""Lists the tables by name and loads the module of a name when it is requested."""

from __future__ import annotations

from importlib import import_module

from tools.errors import InputError
from tools.research.reproduce.rows import Table

MODULES: dict[str, str] = {
    "sensing": "tools.research.reproduce.sensing",
    "real-sensors": "tools.research.reproduce.real_sensors",
    "endoscope": "tools.research.reproduce.endoscope",
    "tremor": "tools.research.reproduce.tremor",
    "actuation": "tools.research.reproduce.actuation",
    "emps": "tools.research.reproduce.emps",
    "measured": "tools.research.reproduce.measured",
}
OLD_NAMES = {"mismatch-real": "measured"}


def expand(names: list[str]) -> list[str]:
    """``all`` is every name, in order; ``InputError`` for one that is not there."""
    if "all" in names:
        return list(MODULES)
    names = [OLD_NAMES.get(name, name) for name in names]
    for name in names:
        if name not in MODULES:
            raise InputError(f"'{name}' is no table; there are: {', '.join(MODULES)}, all")
    return list(dict.fromkeys(names))


def check(name: str) -> None:
    """``InputError`` when a table's inputs are not there: calls ``check()`` of its module, where it has one."""
    ready = getattr(import_module(MODULES[name]), "check", None)
    if ready is not None:
        ready()


def reproduce_table(name: str, **options: object) -> Table:
    """Compute one table: calls ``table()`` of its module with the options that it alone has."""
    return import_module(MODULES[name]).table(**options)
