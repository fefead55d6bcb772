"""Compiling for the first run: it happens once, and what a part compiles is found by the run."""

from __future__ import annotations

import gc
import io
import sys
from pathlib import Path

import pytest
from rich.console import Console

from hal import compiled
from hal.bench import load_bench
from hal.children import child_command, child_environment
from tests.conftest import DEFAULT_BENCH
from tools import prepare as module
from tools.prepare import WAVES, compile_part, prepare


@pytest.mark.parametrize(("code", "starts"), [(0, 3), (1, 4)])
def test_once_unless_it_failed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, code: int, starts: int) -> None:
    started: list[str] = []

    def command(_: str, part: str, *arguments: str) -> list[str]:
        started.append(part)
        return [sys.executable, "-c", f"print('compiled'); raise SystemExit({code})"]

    monkeypatch.setattr(compiled, "user_cache", lambda: tmp_path)
    monkeypatch.setattr(module, "child_command", command)
    console = Console(file=io.StringIO())
    for _ in range(2):
        prepare(load_bench(DEFAULT_BENCH), None, console)
    gc.collect()  # a pipe that is still open would be a ResourceWarning here, and so a failure
    assert len(started) == starts
    assert set(started) <= {part for wave in WAVES for part in wave}


def test_another_method_is_another_preparation() -> None:
    bench = load_bench(DEFAULT_BENCH)
    assert module._fingerprint(bench, None) != module._fingerprint(bench, "wflc_flc")
    assert module._fingerprint(bench, None) == module._fingerprint(bench, None)


def test_every_part_compiles() -> None:
    for part in (part for wave in WAVES for part in wave):
        compile_part(part, load_bench(DEFAULT_BENCH), None)


def test_a_child_never_runs_what_lies_in_the_users_folder(tmp_path: Path) -> None:
    """``random.py`` in the folder where the user stands is not the standard library's."""
    import subprocess

    (tmp_path / "random.py").write_text("raise SystemExit('the user\\'s random.py ran')\n")
    (tmp_path / "hal").mkdir()
    (tmp_path / "hal" / "__init__.py").write_text("raise SystemExit('the user\\'s hal ran')\n")
    done = subprocess.run(
        child_command("tools.cli.main", "--version"), cwd=tmp_path, env=child_environment(),
        capture_output=True, text=True, check=False,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    assert "user's" not in done.stdout + done.stderr
