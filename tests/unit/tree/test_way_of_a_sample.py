"""The way of a sample in docs/architecture.md: eight functions, each where the page says, each leading to the next."""

from __future__ import annotations

import ast
import re
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[3]
ROW = re.compile(r"^\| \d \| \[`([\w.]+)`\]\(\.\./([\w/]+\.py)\)", re.MULTILINE)
STEPS = ROW.findall((ROOT / "docs" / "architecture.md").read_text(encoding="utf-8"))


def found(name: str, path: str) -> ast.FunctionDef:
    """The function, or method as ``Class.name``, in the file."""
    body: list[ast.stmt] = ast.parse((ROOT / path).read_text(encoding="utf-8")).body
    for part in name.split("."):
        node = next(n for n in body if isinstance(n, ast.FunctionDef | ast.ClassDef) and n.name == part)
        body = node.body
    assert isinstance(node, ast.FunctionDef)
    return node


def called(node: ast.AST) -> set[str]:
    """Names of what is called or handed on in ``node``."""
    return {
        n.attr if isinstance(n, ast.Attribute) else n.id
        for n in ast.walk(node)
        if isinstance(n, ast.Attribute | ast.Name)
    }


def test_there_are_eight():
    assert len(STEPS) == 8


@pytest.mark.parametrize(("name", "path"), STEPS, ids=[name for name, _ in STEPS])
def test_it_is_where_the_page_says(name: str, path: str):
    assert found(name, path)


def test_each_leads_to_the_next():
    nodes = dict(zip((name.rsplit(".", 1)[-1] for name, _ in STEPS), (found(*step) for step in STEPS), strict=True))
    micron = ast.parse((ROOT / "firmware_py" / "control" / "instrument.py").read_text(encoding="utf-8"))
    table = ast.parse((ROOT / "firmware_py" / "control" / "tasks.py").read_text(encoding="utf-8"))
    scans = ast.parse((ROOT / "firmware_py" / "control" / "scan_input.py").read_text(encoding="utf-8"))
    assert "read_scans" in called(scans)
    assert {"ScanInput", "task_rows"} <= called(micron)
    stages = ast.parse((ROOT / "firmware_py" / "control" / "chain.py").read_text(encoding="utf-8"))
    assert {"sense_kernel", "estimate_kernel", "actuate_kernel"} <= called(stages)  # which ``bind`` lets the step call
    assert {"sense_entry", "estimate_entry", "actuate_entry"} <= called(nodes["step_kernel"])
    assert "write" in called(nodes["actuate"])
    assert {"sense", "estimate", "actuate"} <= called(table)
