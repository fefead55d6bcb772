"""A user's own packages ``tools`` and ``hal``, before ours on the import path: the commands and fixtures find ours."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest

START = Path(__file__).parents[3] / "tools" / "start"


@pytest.fixture
def hers(tmp_path: Path) -> Path:
    """Packages ``tools`` and ``hal`` that are not ours."""
    for name in ("tools", "hal"):
        (tmp_path / name).mkdir()
        (tmp_path / name / "__init__.py").write_text("OWNER = 'she'\n")
    return tmp_path


def run(arguments: list[str], folder: Path) -> subprocess.CompletedProcess[str]:
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join([str(folder), str(START)])}
    return subprocess.run(
        [sys.executable, *arguments], cwd=folder, env=environment, capture_output=True, text=True, check=False
    )


def test_a_command_and_its_children_find_ours(hers: Path) -> None:
    script = "import sys, micron_start; sys.argv[0] = 'micron'; micron_start.main()"
    # the recorder is a child process
    options = ["--virtual", "--seconds", "0.5", "--bench", "micron-can", "--record", "run.mcap"]
    done = run(["-c", script, "run", *options], hers)
    assert done.returncode == 0, done.stderr
    assert (hers / "run.mcap").stat().st_size > 10_000


def test_her_tests_keep_her_packages_until_a_fixture_needs_ours(hers: Path) -> None:
    (hers / "test_hers.py").write_text("import hal\n\ndef test_it():\n    assert hal.OWNER == 'she'\n")
    done = run(["-m", "pytest", "-q", "-p", "no:cacheprovider"], hers)
    assert done.returncode == 0, done.stdout
    (hers / "test_hers.py").write_text("import hal\n\ndef test_it(emulated):\n    emulated('ad5696r', address=12)\n")
    done = run(["-m", "pytest", "-q", "-p", "no:cacheprovider"], hers)
    assert done.returncode == 1
    assert "hal: this package has the name of one of micron-bench" in done.stdout
    (hers / "test_hers.py").write_text("def test_it(emulated):\n    assert emulated('ad5696r', address=12).smbus()\n")
    done = run(["-m", "pytest", "-q", "-p", "no:cacheprovider"], hers)
    assert done.returncode == 0, done.stdout
