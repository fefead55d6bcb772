"""Runs a program of somebody else on the buses of ``micron emulate``."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import pytest

ROOT = Path(__file__).parents[2]
BENCH = ROOT / "tests" / "wire" / "emulators" / "emulated.toml"


def need_client(module: str) -> None:
    """Skip the test where a package of the extra ``clients`` is not installed."""
    if find_spec(module) is None:
        pytest.skip(f"{module} is not installed: pip install -e '.[clients]'")


def run_client(folder: Path, program: str, *, has_other_amplifiers: bool = True) -> Any:
    """Run ``program`` in ``folder`` under ``micron emulate``; return the JSON of its last line.

    The DAC and the CAN node drive the same stacks as the E-727: a test that moves those leaves them out."""
    text = BENCH.read_text(encoding="utf-8")
    (folder / "bench.toml").write_text(
        text if has_other_amplifiers else text.partition("[device.dac]")[0], encoding="utf-8"
    )
    (folder / "client.py").write_text(program, encoding="utf-8")
    command = [sys.executable, "-m", "tools.cli.main", "emulate", "bench.toml"]
    done = subprocess.run(
        [*command, "--", sys.executable, "-W", "ignore", "client.py"],
        cwd=folder,
        env={**os.environ, "PYTHONPATH": str(ROOT)},
        capture_output=True,
        text=True,
        timeout=200,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    return json.loads(done.stdout.splitlines()[-1])
