"""Every emulated device says what it does not model, where its protocol comes from, and nothing it must not know."""

from __future__ import annotations

import ast
from pathlib import Path

import pytest

import sim_devices.devices as devices

FOLDER = Path(devices.__file__).parent
FILES = sorted(p for p in FOLDER.glob("*.py") if p.name not in ("__init__.py", "faces.py", "acting.py"))


@pytest.mark.parametrize("path", FILES, ids=lambda p: p.stem)
def test_docstring_ends_with_model_limits(path: Path) -> None:
    docstring = ast.get_docstring(ast.parse(path.read_text(encoding="utf-8"))) or ""
    head, mark, limits = docstring.rpartition("Model limits\n")
    assert mark, f"{path.name}: the module docstring has no 'Model limits' section"
    assert "Source" in head, f"{path.name}: no source before the limits"
    assert limits.lstrip().startswith("- "), f"{path.name}: limits are a list"
    assert all(line.startswith(("- ", "  ")) for line in limits.splitlines() if line), "the section comes last"


def test_all_devices_are_found() -> None:
    assert {"di4108", "ads1115", "ad5696r", "e727", "can_piezo_node", "can_stop_button"} <= {p.stem for p in FILES}
