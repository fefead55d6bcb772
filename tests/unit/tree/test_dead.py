"""Nothing dead: every function and class is named somewhere besides where it is defined."""

from __future__ import annotations

import ast
import re
from collections import Counter
from pathlib import Path

ROOT = Path(__file__).parents[3]
PACKAGES = ("hal", "drivers", "firmware_py", "sim_devices", "tools")
ELSEWHERE = ("tests", "benchmarks", "benches", "docs", ".ci")
TEXTS = (".py", ".toml", ".md", ".js", ".html")
# what a framework finds by a decorator
FOUND_BY = re.compile(r"command|callback|validator|serializer|overload|fixture|property\.setter")


def named(code: str) -> list[str]:
    """Functions and classes that ``code`` defines for others to call."""
    nodes = [
        n for n in ast.walk(ast.parse(code)) if isinstance(n, ast.FunctionDef | ast.AsyncFunctionDef | ast.ClassDef)
    ]
    return [
        n.name
        for n in nodes
        if not n.name.startswith("__") and not any(FOUND_BY.search(ast.unparse(d)) for d in n.decorator_list)
    ]


def test_it_sees_definitions() -> None:
    assert named("@app.command()\ndef a(): ...\nclass B:\n    def c(self): ...\n    def __len__(self): ...") == [
        "B",
        "c",
    ]


def test_everything_is_named_twice() -> None:
    files = [p for folder in (*PACKAGES, *ELSEWHERE) for p in (ROOT / folder).rglob("*") if p.suffix in TEXTS]
    words: Counter[str] = Counter()
    for file in (*files, ROOT / "pyproject.toml", ROOT / "README.md"):
        words.update(re.findall(r"\w+", file.read_text(encoding="utf-8")))
    dead = [
        f"{file.relative_to(ROOT)}: {name}"
        for package in PACKAGES
        for file in sorted((ROOT / package).rglob("*.py"))
        for name in named(file.read_text(encoding="utf-8"))
        if words[name] == 1
    ]
    assert not dead
