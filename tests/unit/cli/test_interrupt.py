"""Ctrl-C: every command stops, keeps what it measured, says so in one line and ends with 130, its children with it."""

from __future__ import annotations

import ast
import json
import os
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path

import pytest
import typer
from typer.testing import CliRunner

from tools import interrupt
from tools.cli.common import clear_errors
from tools.output import write_json

ROOT = Path(__file__).parents[3]
WORK_S = 5.0
"""CPU time after which a command has been imported and is at work, on a machine of any speed and load."""

FAST = [("simulate", "--seconds", "80000"), ("soak", "--without-wires", "--seconds", "80000")]
LONG = [
    ("run", "--virtual", "--seconds", "20000"),
    ("run", "--seconds", "20000"),
    ("run", "--virtual", "--seconds", "20000", "--record", "{tmp}/run.mcap"),
    ("soak", "--seconds", "20000"),
    ("hands", "--seconds", "600"),
    ("faults", "--jobs", "2"),
    ("mismatch", "diagnose", "{motor}/friction/ode.toml"),
    ("mismatch", "diagnose", "{motor}", "--jobs", "2"),
    ("mismatch", "prove", "--cases", "40", "--seed", "1", "--jobs", "2"),
    ("reproduce", "sensing", "tremor"),
    ("sensing", "budget", "--seconds", "600"),
    ("latency", "--seconds", "600"),
    ("scope", "--seconds", "3000"),
    ("bench", "--port", "0", "--recordings", "{tmp}/recordings"),
]


def cpu_s(group: int) -> float:
    """CPU time of all processes of a group."""
    total = 0
    for stat in Path("/proc").glob("[0-9]*/stat"):
        try:
            fields = stat.read_text().rpartition(")")[2].split()
        except OSError:
            continue
        if int(fields[2]) == group:
            total += int(fields[11]) + int(fields[12])
    return total / os.sysconf("SC_CLK_TCK")


def left_over(session: int) -> list[str]:
    """Processes of a session that are still there."""
    found: list[str] = []
    for stat in Path("/proc").glob("[0-9]*/stat"):
        try:
            name, _, rest = stat.read_text().rpartition(")")
        except OSError:
            continue
        if int(rest.split()[3]) == session and rest.split()[0] != "Z":
            found.append(name)
    return found


@pytest.fixture(scope="module")
def motor(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("motor")
    subprocess.run([sys.executable, "make.py", str(folder)], cwd=ROOT / "examples" / "motor", check=True)
    return folder


@pytest.mark.parametrize(
    "words", [*FAST, *(pytest.param(words, marks=pytest.mark.slow) for words in LONG)], ids=lambda w: " ".join(w[:3])
)
def test_a_command_that_is_interrupted(words: tuple[str, ...], tmp_path: Path, request: pytest.FixtureRequest) -> None:
    """The signal goes to the whole process group, as from a terminal."""
    places = {"tmp": str(tmp_path)}
    if "{motor}" in " ".join(words):
        places["motor"] = str(request.getfixturevalue("motor"))
    command = [sys.executable, "-m", "tools.cli.main", *(word.format(**places) for word in words)]
    with (tmp_path / "said").open("wb") as said:
        process = subprocess.Popen(
            command, cwd=ROOT, stdin=subprocess.DEVNULL, stdout=said, stderr=said, start_new_session=True
        )
        try:
            while cpu_s(process.pid) < WORK_S:
                assert process.poll() is None, (tmp_path / "said").read_text()
                time.sleep(0.05)
            os.killpg(process.pid, signal.SIGINT)
            status = process.wait(120)
            until_s = time.monotonic() + 30
            while left_over(process.pid) and time.monotonic() < until_s:
                time.sleep(0.05)
            assert left_over(process.pid) == []
        finally:
            if left_over(process.pid):
                os.killpg(process.pid, signal.SIGKILL)
            process.wait()
    text = (tmp_path / "said").read_text()
    assert status == 130, text
    assert "Traceback" not in text
    assert "KeyboardInterrupt" not in text


def test_a_second_one_ends_at_once(tmp_path: Path) -> None:
    """A command that is slow to clean up is ended by the kernel."""
    script = tmp_path / "slow.py"
    script.write_text(
        "import sys, time\nfrom tools.interrupt import install_handler\ninstall_handler()\n"
        "try:\n    print('ready', flush=True); time.sleep(600)\n"
        "except KeyboardInterrupt:\n    print('cleaning', flush=True); time.sleep(600)\n"
    )
    process = subprocess.Popen(
        [sys.executable, str(script)], stdout=subprocess.PIPE, text=True, env={**os.environ, "PYTHONPATH": str(ROOT)}
    )
    assert process.stdout is not None
    with process.stdout as out:
        assert out.readline() == "ready\n"
        process.send_signal(signal.SIGINT)
        assert out.readline() == "cleaning\n"
        process.send_signal(signal.SIGINT)
        assert process.wait(60) == -signal.SIGINT  # which a shell calls 130


def test_workers_are_ended_by_the_first_one(monkeypatch: pytest.MonkeyPatch) -> None:
    killed: list[str] = []

    class Worker:
        def kill(self) -> None:
            killed.append("worker")

    monkeypatch.setattr(interrupt.multiprocessing, "active_children", lambda: [Worker(), Worker()])
    before = signal.getsignal(signal.SIGINT)
    try:
        interrupt.install_handler()
        assert not interrupt.was_interrupted()
        with pytest.raises(KeyboardInterrupt):
            signal.raise_signal(signal.SIGINT)
        assert interrupt.was_interrupted()
    finally:
        signal.signal(signal.SIGINT, before)
    assert killed == ["worker", "worker"]


@pytest.mark.parametrize("kept", [True, False])
def test_what_was_measured_is_kept_and_the_json_says_that_it_is_not_whole(tmp_path: Path, kept: bool) -> None:
    app = typer.Typer()
    target = tmp_path / "out.json"

    def work() -> Iterator[int]:
        if kept:
            yield 1
        raise KeyboardInterrupt

    @app.command()
    def command() -> None:
        rows: list[int] = []
        with clear_errors():
            with interrupt.keep_what_is_there():
                for row in work():
                    rows.append(row)  # noqa: PERF402 - as the commands do
            interrupt.need_some(rows)
            write_json({"rows": rows}, str(target))
            raise typer.Exit(1)  # a verdict on half of the work is none

    done = CliRunner().invoke(app, [])
    assert done.exit_code == 130
    assert "micron: stopped by Ctrl-C" in done.output
    assert target.exists() == kept
    if kept:
        assert json.loads(target.read_text()) == {"rows": [1], "stopped": True}


def commands_of(source: str) -> list[tuple[str, bool]]:
    """Functions with an option or argument of typer, and whether all their work stands in ``clear_errors``."""
    found: list[tuple[str, bool]] = []
    for node in ast.parse(source).body:
        if isinstance(node, ast.FunctionDef) and ast.get_docstring(node) and "Example: micron" in ast.unparse(node):
            guarded = [
                n
                for n in ast.walk(node)
                if isinstance(n, ast.With) and "clear_errors()" in ast.unparse(n.items[0].context_expr)
            ]
            found.append((node.name, bool(guarded)))
    return found


def test_every_command_has_the_habit() -> None:
    found = {
        f"{file.stem}.{name}": guarded
        for file in sorted((ROOT / "tools" / "cli").glob("*.py"))
        for name, guarded in commands_of(file.read_text())
    }
    assert len(found) > 35
    assert [name for name, guarded in found.items() if not guarded] == []
