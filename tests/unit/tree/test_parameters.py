"""No function of the product takes more than six positional parameters.

A kernel takes ``(input, state, params)``; what belongs together is a record (``firmware_py.records``), a named tuple or
a dataclass.
"""

from __future__ import annotations

import ast
from pathlib import Path

ROOT = Path(__file__).parents[3]
ROOMS = ("hal", "drivers", "firmware_py", "sim_devices", "tools")
MOST = 6


def test_no_function_has_too_many_parameters():
    """``self`` and ``cls`` do not count; research is not the product."""
    found: list[str] = []
    for room in ROOMS:
        for path in (ROOT / room).rglob("*.py"):
            name = path.relative_to(ROOT).as_posix()
            if name.startswith("tools/research/"):
                continue
            for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
                if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef):
                    names = [a.arg for a in (*node.args.posonlyargs, *node.args.args)]
                    if len([n for n in names if n not in ("self", "cls")]) > MOST:
                        found.append(f"{name} {node.name}")
    assert not found, f"more than {MOST} positional parameters; make a record or a dataclass of them: {found}"
