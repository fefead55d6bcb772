"""Each folder's first file says what lives there and what must not, in a few lines."""

from __future__ import annotations

import ast
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[3]
ROOMS = ("hal", "drivers", "sim_devices", "firmware_py", "tools", "benches", "benchmarks")
FOLDERS = sorted(
    folder.relative_to(ROOT)
    for room in ROOMS
    for folder in [ROOT / room, *(p for p in (ROOT / room).rglob("*") if p.is_dir())]
    if any(folder.glob("*.py"))
)


@pytest.mark.parametrize("folder", FOLDERS, ids=str)
def test_it_says_what_lives_there_and_what_must_not(folder: Path):
    first = ROOT / folder / "__init__.py"
    assert first.is_file()
    said = ast.get_docstring(ast.parse(first.read_text(encoding="utf-8"))) or ""
    assert "What lives here: " in said or "Here: " in said
    assert "What must not: " in said or "Not here: " in said
    assert len(said.splitlines()) <= 9


@pytest.mark.parametrize("room", ["hal", "drivers", "sim_devices", "firmware_py", "tools"])
def test_its_types_are_for_others_too(room: str):
    """PEP 561: without the marker a type checker treats an installed package as untyped."""
    assert (ROOT / room / "py.typed").is_file()
