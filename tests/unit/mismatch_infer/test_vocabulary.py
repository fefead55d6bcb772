"""The engine on one score knows no effect by name and speaks no English."""

from __future__ import annotations

import ast
import re
from collections.abc import Iterator
from pathlib import Path

import pytest

import tools.mismatch.infer
from sim_devices.physics.catalogue import EFFECTS

FOLDER = Path(tools.mismatch.infer.__file__).parent
FILES = sorted(FOLDER.glob("*.py"))


def _texts(file: Path) -> Iterator[tuple[str, bool]]:
    """(text, whether it is a docstring) of every string in a source file."""
    tree = ast.parse(file.read_text())
    bodies = (body for node in ast.walk(tree) if isinstance(body := getattr(node, "body", None), list))
    lone = (statement.value for body in bodies for statement in body if isinstance(statement, ast.Expr))
    documented = {id(value) for value in lone if isinstance(value, ast.Constant)}
    for node in ast.walk(tree):
        if isinstance(node, ast.Constant) and isinstance(node.value, str):
            yield node.value, id(node) in documented


def test_there_is_something_to_look_at() -> None:
    assert len(FILES) >= 6
    assert len(EFFECTS) > 30


@pytest.mark.parametrize("file", FILES, ids=lambda f: f.name)
def test_no_effect_is_known_by_name(file: Path) -> None:
    names = re.compile(rf"\b({'|'.join(map(re.escape, sorted(EFFECTS)))})\b")
    assert not names.findall(file.read_text())


@pytest.mark.parametrize("file", FILES, ids=lambda f: f.name)
def test_what_is_not_documentation_is_no_sentence(file: Path) -> None:
    assert not [text for text, documents in _texts(file) if not documents and re.search(r"\S\s+\S", text)]
