"""A bench whose provider crashes, ends the process, hangs or eats memory: one message, exit status 2."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[3]
BODIES = {
    "crashes (SIGSEGV)": "ctypes.string_at(0)",
    "crashed (SIGABRT)": "os.abort()",
    "ended the process with status 0": "os._exit(0)",
    "ended the process with status 7": "os._exit(7)",
}


def micron(folder: Path, *words: str) -> tuple[int, str]:
    environment = {
        **os.environ,
        "PYTHONPATH": os.pathsep.join((str(ROOT), str(folder))),
        "XDG_STATE_HOME": str(folder / "state"),
        "COLUMNS": "200",
    }
    done = subprocess.run(
        [sys.executable, "-m", "tools.cli.main", *words],
        env=environment, cwd=folder, stdin=subprocess.DEVNULL, capture_output=True, text=True, timeout=300, check=False,
    )  # fmt: skip
    return done.returncode, done.stderr


def bench(folder: Path, body: str) -> Path:
    (folder / "hers.py").write_text(f"import ctypes, os\ndef provider(*args, **options):\n    {body}\n")
    text = (ROOT / "benches" / "micron.toml").read_text()
    text = text.replace("sim_devices.register:provider", "hers:provider")
    path = folder / "bench.toml"
    path.write_text(text.replace('"calibration/', f'"{ROOT}/benches/calibration/'))
    return path


@pytest.mark.parametrize(("says", "body"), BODIES.items())
def test_the_end_of_its_process_is_one_message(tmp_path: Path, says: str, body: str) -> None:
    path = bench(tmp_path, body)
    assert micron(tmp_path, "trust", str(path))[0] == 0
    status, said = micron(tmp_path, "scope", "--bench", str(path), "--virtual", "--seconds", "1")
    assert status == 2, said
    assert f"code that is not ours (hers:provider) {says.replace('crashes', 'crashed')}" in said
    assert said.count("micron:") == 1


def test_a_status_of_the_command_itself_is_handed_on(tmp_path: Path) -> None:
    path = bench(tmp_path, "raise SystemExit(7)")
    micron(tmp_path, "trust", str(path))
    assert micron(tmp_path, "scope", "--bench", str(path), "--virtual", "--seconds", "1") == (7, "")


@pytest.mark.slow
def test_too_much_memory_does_not_take_the_machine(tmp_path: Path) -> None:
    path = bench(tmp_path, "x = [bytearray(1 << 30) for _ in range(64)]")
    micron(tmp_path, "trust", str(path))
    status, said = micron(tmp_path, "scope", "--bench", str(path), "--virtual", "--seconds", "1")
    assert status == 2, said
    assert "memory" in said
