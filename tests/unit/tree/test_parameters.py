"""No function of the product takes more than six positional parameters; those that still do are listed and only leave.

A kernel takes ``(input, state, params)``; what belongs together is a record (``firmware_py.records``) or a dataclass.
"""

from __future__ import annotations

import ast
from pathlib import Path

ROOT = Path(__file__).parents[3]
ROOMS = ("hal", "drivers", "firmware_py", "sim_devices", "tools")
MOST = 6
LEFT = Path(__file__).with_name("parameters_left.txt")
"""One function a line, ``FILE FUNCTION``. Lines are removed and never added."""


def long_functions() -> set[str]:
    """Return the functions with more than ``MOST`` positional parameters (``self`` and ``cls`` do not count)."""
    found: set[str] = set()
    for room in ROOMS:
        for path in (ROOT / room).rglob("*.py"):
            name = path.relative_to(ROOT).as_posix()
            if name.startswith("tools/research/"):
                continue  # not the product
            for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
                if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef):
                    names = [a.arg for a in (*node.args.posonlyargs, *node.args.args)]
                    if len([n for n in names if n not in ("self", "cls")]) > MOST:
                        found.add(f"{name} {node.name}")
    return found


def left() -> set[str]:
    return set(LEFT.read_text(encoding="utf-8").splitlines())


def test_no_function_is_added_to_those_with_too_many_parameters():
    added = sorted(long_functions() - left())
    assert not added, f"more than {MOST} positional parameters; make a record or a dataclass of them: {added}"


def test_the_list_holds_only_what_is_there():
    assert not sorted(left() - long_functions()), "these are mended: remove their lines from parameters_left.txt"
