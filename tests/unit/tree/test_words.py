"""Docstrings begin with a statement, and names say what a value is (issue 21, item 8)."""

from __future__ import annotations

import ast
import re
from collections.abc import Iterator
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[3]
ROOMS = (
    "hal",
    "drivers",
    "sim_devices",
    "firmware_py",
    "tools/bench",
    "tools/calibrate",
    "tools/cli",
    "tools/closed_loop",
    "tools/data",
    "tools/diagnose",
    "tools/emulate",
    "tools/formats",
    "tools/guest",
    "tools/heal",
    "tools/imu",
    "tools/mismatch",
    "tools/noise",
    "tools/reports",
    "tools/start",
    "tools/research/cli",
    "tools/research/endoscope",
    "tools/research/faults",
    "tools/research/manipulator",
    "tools/research/placement",
    "tools/research/reports",
    "tools/research/reproduce",
    "tools/research/results",
    "tools/research/supply",
    "tools/research/tremor",
)
WITHOUT_SUBJECT = re.compile(r"(Of|What|Whether|So|How|Where|Which|Whose|When|From|As|At|For|Not|All|Both|Its|One) ")
"""A docstring that begins so is a fragment: it needs the text before it, or leaves out the verb."""
NAMES = {"said", "taken", "mine", "his", "theirs", "there", "shown", "told", "parted", "begun", "akin"}
"""Participles and pronouns that say nothing of a value (words.md, rule 4)."""


def fragments(code: str) -> Iterator[str]:
    """Yield the docstrings of modules, classes and functions that begin with a fragment."""
    for node in ast.walk(ast.parse(code)):
        if isinstance(node, ast.Module | ast.ClassDef | ast.FunctionDef | ast.AsyncFunctionDef):
            text = ast.get_docstring(node) or ""
            if WITHOUT_SUBJECT.match(text):
                yield text.splitlines()[0]


def vague_names(code: str) -> Iterator[str]:
    """Yield the names of ``NAMES`` that the code gives to values, arguments, attributes, functions or classes."""
    for node in ast.walk(ast.parse(code)):
        name = ""
        if isinstance(node, ast.Name | ast.Attribute) and isinstance(node.ctx, ast.Store):
            name = node.id if isinstance(node, ast.Name) else node.attr
        elif isinstance(node, ast.arg):
            name = node.arg
        elif isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef | ast.ClassDef):
            name = node.name
        if name.strip("_") in NAMES:
            yield name


def test_fragments_and_vague_names_are_seen():
    code = '"""What it is."""\ndef f(said):\n    """Return the rest."""\n    self.taken = there = said'
    assert list(fragments(code)) == ["What it is."]
    assert sorted(vague_names(code)) == ["said", "taken", "there"]


@pytest.mark.parametrize("room", ROOMS)
def test_text_follows_the_rules(room: str):
    faults: list[str] = []
    for file in sorted((ROOT / room).rglob("*.py")):
        code = file.read_text(encoding="utf-8")
        faults += [f"{file.relative_to(ROOT)}: {fault}" for fault in (*fragments(code), *vague_names(code))]
    assert not faults
