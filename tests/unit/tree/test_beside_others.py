"""A user's own packages ``tools`` and ``hal``, before ours on the import path: the commands and fixtures find ours."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest

PYTEST = ["-m", "pytest", "-q", "-p", "no:cacheprovider", "-p", "micron_pytest"]
START = Path(__file__).parents[3] / "tools" / "start"


@pytest.fixture
def hers(tmp_path: Path) -> Path:
    """Packages ``tools`` and ``hal`` that are not ours."""
    for name in ("tools", "hal"):
        (tmp_path / name).mkdir()
        (tmp_path / name / "__init__.py").write_text("OWNER = 'she'\n")
    return tmp_path


def run(arguments: list[str], folder: Path) -> subprocess.CompletedProcess[str]:
    path = os.pathsep.join([str(folder), str(START)])
    environment = {**os.environ, "PYTHONPATH": path, "PYTEST_DISABLE_PLUGIN_AUTOLOAD": "1"}
    return subprocess.run(
        [sys.executable, *arguments], cwd=folder, env=environment, capture_output=True, text=True, check=False
    )


@pytest.mark.slow
def test_a_command_and_its_children_find_ours(hers: Path) -> None:
    script = "import sys, micron_start; sys.argv[0] = 'micron'; micron_start.main()"
    done = run(["-c", script, "data", "list"], hers)
    assert done.returncode == 0, done.stderr
    child = (
        "import subprocess, sys, micron_start\n"
        "micron_start.put_ours_first()\n"
        "from hal.children import child_command, child_environment\n"
        "sys.exit(subprocess.call(child_command('tools.cli.main', '--version'), env=child_environment()))"
    )
    done = run(["-c", child], hers)
    assert done.stdout.startswith("micron "), done.stderr


def test_her_tests_keep_her_packages_until_a_fixture_needs_ours(hers: Path) -> None:
    (hers / "test_hers.py").write_text("import hal\n\ndef test_it():\n    assert hal.OWNER == 'she'\n")
    done = run(PYTEST, hers)
    assert done.returncode == 0, done.stdout
    (hers / "test_hers.py").write_text("import hal\n\ndef test_it(emulated):\n    emulated('ad5696r', address=12)\n")
    done = run(PYTEST, hers)
    assert done.returncode == 1
    assert "hal: this package has the name of one of micron-bench" in done.stdout
    (hers / "test_hers.py").write_text("def test_it(emulated):\n    assert emulated('ad5696r', address=12).smbus()\n")
    done = run(PYTEST, hers)  # where her tests need none of hers
    assert done.returncode == 0, done.stdout
