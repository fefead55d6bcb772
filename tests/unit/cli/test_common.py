"""JSON output and errors of all commands."""

import errno
import json
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import typer
from rich.table import Table

from hal.errors import BenchError, DeviceNotFound, HalTimeout
from tools.cli.common import Exit, clear_errors, console, print_whole
from tools.errors import InputError
from tools.output import check_writable, write_json
from tools.terminal import progress_bar, task_name


def test_json_is_plain_and_whole(tmp_path: Path):
    target = tmp_path / "r.json"
    write_json({"a": np.float64(1.5), "b": np.arange(3), "c": float("nan"), "d": Path("x")}, str(target))
    assert json.loads(target.read_text()) == {"a": 1.5, "b": [0, 1, 2], "c": None, "d": "x"}
    assert [p.name for p in tmp_path.iterdir()] == ["r.json"]


def test_json_to_standard_output(capsys: pytest.CaptureFixture[str]):
    write_json({"x": 1}, "-")
    assert json.loads(capsys.readouterr().out) == {"x": 1}


def test_a_missing_folder_is_refused_before_work(tmp_path: Path):
    with pytest.raises(InputError, match="does not exist; create it first"):
        check_writable("-", None, tmp_path / "no" / "r.json")


def test_a_table_in_a_pipe_is_whole(capsys: pytest.CaptureFixture[str]):
    table = Table()
    for _ in range(12):
        table.add_column("a column that is wide", no_wrap=True)
    table.add_row(*(f"value number {n:03d}" for n in range(12)))
    print_whole(table)
    out = capsys.readouterr().out
    assert all(f"value number {n:03d}" in out for n in range(12))
    assert out.count("a column that is wide") == 12


@pytest.mark.parametrize(
    ("error", "code"),
    [
        (InputError("x"), Exit.BAD_INPUT),
        (BenchError("x"), Exit.BAD_INPUT),
        (DeviceNotFound("x"), Exit.DEVICE_MISSING),
        (HalTimeout("x"), Exit.FAILED),
    ],
)
def test_exit_codes(error: Exception, code: Exit, capsys: pytest.CaptureFixture[str]):
    with pytest.raises(typer.Exit) as caught, clear_errors():
        raise error
    assert caught.value.exit_code == code
    assert capsys.readouterr().err.startswith("micron: ")


REFUSED = """
import resource
from pathlib import Path

import numpy as np
import typer

from tools.cli.common import clear_errors


def run() -> None:
    with clear_errors():
        np.ones(100_000_000)


mapped = int(Path("/proc/self/statm").read_text().split()[0]) * resource.getpagesize()
resource.setrlimit(resource.RLIMIT_AS, (mapped + 32_000_000, resource.getrlimit(resource.RLIMIT_AS)[1]))
typer.run(run)
"""


@pytest.mark.skipif(sys.platform != "linux", reason="the limit is read off /proc")
def test_a_computer_without_memory_to_start_with_gets_one_message():
    """Below a limit of the operating system that leaves 32 MB: refused, with what to do, and no stack trace."""
    done = subprocess.run([sys.executable, "-c", REFUSED], capture_output=True, text=True)
    assert done.returncode == Exit.FAILED, done.stderr
    assert done.stderr.startswith("micron: not enough memory: Unable to allocate")
    assert done.stderr.endswith("end other programs, or ask for less\n")
    assert done.stderr.count("\n") == 1


def test_keys_in_brackets_reach_the_reader(capsys: pytest.CaptureFixture[str]):
    with pytest.raises(typer.Exit), clear_errors():
        raise BenchError("bench.toml: [device.daq.bus] no such bus")
    assert "[device.daq.bus]" in capsys.readouterr().err


def test_a_progress_display_prints_nothing_in_a_pipe(capsys: pytest.CaptureFixture[str]):
    with progress_bar(console(), task_name()) as progress:
        progress.add_task("inputs", total=3)
    assert capsys.readouterr() == ("", "")


def test_a_full_disk_behind_standard_output_is_one_message(capsys: pytest.CaptureFixture[str]):
    with pytest.raises(typer.Exit) as caught, clear_errors():
        raise OSError(errno.ENOSPC, "No space left on device")
    assert caught.value.exit_code == Exit.FAILED
    said = capsys.readouterr().err
    assert said == "micron: standard output: cannot be written (No space left on device); free some space\n"
