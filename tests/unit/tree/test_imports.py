"""No circle of imports, and the command line on top of the other tools. Directions between rooms: import-linter."""

from __future__ import annotations

from collections.abc import Iterator

import grimp
import pytest

ROOMS = ("hal", "drivers", "sim_devices", "firmware_py", "tools")


@pytest.fixture(scope="module")
def imports() -> dict[str, set[str]]:
    """Module to the modules that it imports, at its top, within functions or for types alone."""
    graph = grimp.build_graph(*ROOMS, cache_dir=None)
    return {module: set(graph.find_modules_directly_imported_by(module)) for module in graph.modules}


def circles(imports: dict[str, set[str]]) -> Iterator[set[str]]:
    """What is left when modules that import nothing that is left are taken away, again and again, from both ends."""
    left = {module: imported - {module} for module, imported in imports.items()}
    while True:
        imported_by_any = set().union(*left.values()) if left else set()
        ends = {m for m, imported in left.items() if not imported & left.keys() or m not in imported_by_any}
        if not ends:
            break
        left = {m: imported - ends for m, imported in left.items() if m not in ends}
    if left:
        yield set(left)


def test_a_circle_is_found():
    assert list(circles({"a": {"b"}, "b": {"c"}, "c": {"b"}, "d": {"a"}})) == [{"b", "c"}]
    assert not list(circles({"a": {"b"}, "b": {"c"}, "c": set()}))


def test_no_circle_of_imports(imports: dict[str, set[str]]):
    assert not list(circles(imports))


def test_no_tool_imports_the_command_line(imports: dict[str, set[str]]):
    found = {
        (module, imported)
        for module, imported_ones in imports.items()
        for imported in imported_ones
        if imported.startswith("tools.cli")
        and not module.startswith(("tools.cli", "tools.research.cli", "tools.start"))  # what the script calls
    }
    assert not found
