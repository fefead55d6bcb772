"""``import hal`` stays light: counted by what it pulls in, because a wall clock on a shared machine proves nothing."""

from __future__ import annotations

import json
import subprocess
import sys

import pytest

HEAVY = ("numpy", "scipy", "numba", "llvmlite", "pydantic", "serial", "smbus2", "can", "cantools", "matplotlib", "rich")
MEASURE = "import sys, json; import {name}; print(json.dumps([m.partition('.')[0] for m in sys.modules]))"


def modules(name: str) -> list[str]:
    """Top packages that a fresh interpreter has after ``import name``."""
    run = subprocess.run([sys.executable, "-c", MEASURE.format(name=name)], capture_output=True, text=True, check=True)
    return json.loads(run.stdout)


@pytest.mark.parametrize("name", ["hal", "hal.errors"])
def test_nothing_heavy_comes_with_it(name: str) -> None:
    found = modules(name)
    assert "hal" in found
    assert not set(HEAVY) & set(found)
    bare = modules("sys")
    assert len(found) - len(bare) < 60


def test_the_count_sees_what_is_heavy() -> None:
    assert "numba" in modules("hal.compiled")
