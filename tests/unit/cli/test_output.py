"""A full disk costs the result that it was for and no other; names are checked before the work."""

from __future__ import annotations

import io
import json
import os
import stat
from collections.abc import Callable
from pathlib import Path

import pytest
import typer

from tests.command import micron
from tools.cli.common import Exit, clear_errors
from tools.errors import InputError, OutputError
from tools.output import Outputs, check_writable, save_figure, write_bytes_atomic, write_json


def test_what_was_there_stays_when_the_disk_is_full(tmp_path: Path, full_disk: Callable[[str], None]) -> None:
    path = tmp_path / "r.json"
    path.write_text("older")
    full_disk("r.json")
    with pytest.raises(OutputError, match=r"r\.json: cannot be written \(No space left on device\); free some space"):
        write_json({"a": 1}, str(path))
    assert [p.name for p in tmp_path.iterdir()] == ["r.json"]
    assert path.read_text() == "older"


def test_a_full_standard_device_is_one_line_and_status_1(capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(typer.Exit) as caught, clear_errors():
        write_json({"a": 1}, "/dev/full")
    assert caught.value.exit_code == Exit.FAILED
    assert "/dev/full: cannot be written (No space left on device)" in capsys.readouterr().err
    assert stat.S_ISCHR(os.stat("/dev/full").st_mode)


def test_a_device_stays_a_device_and_a_link_a_link(tmp_path: Path) -> None:
    """Renaming onto /dev/null would put a file in its place, for everybody on the machine."""
    pipe = tmp_path / "pipe"
    os.mkfifo(pipe)
    reader = os.open(pipe, os.O_RDONLY | os.O_NONBLOCK)
    check_writable(pipe)
    write_json([1], str(pipe))
    assert json.loads(os.read(reader, 100)) == [1]
    os.close(reader)
    assert stat.S_ISFIFO(pipe.stat().st_mode)
    (tmp_path / "there").mkdir()
    link = tmp_path / "link.json"
    link.symlink_to(tmp_path / "there" / "r.json")
    write_json([2], str(link))
    assert link.is_symlink()
    assert json.loads((tmp_path / "there" / "r.json").read_text()) == [2]


def test_a_folder_that_takes_no_file_is_refused_before_the_work(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"/proc/r\.json: cannot be written .*name a folder that you may write to"):
        check_writable("/proc/r.json")
    with pytest.raises(InputError, match="this is a folder"):
        check_writable(tmp_path)
    check_writable(tmp_path / "r.json", "/dev/null", "-", None)
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("option", ["--json", "--html", "--record"])
def test_a_run_does_not_begin_when_its_result_has_no_place(option: str, monkeypatch: pytest.MonkeyPatch) -> None:
    def never(*_: object) -> None:
        raise AssertionError("the run has begun")

    monkeypatch.setattr("tools.cli.run.load_bench", never)
    done = micron("run", option, "/proc/result")
    assert done.exit_code == Exit.BAD_INPUT
    assert not isinstance(done.exception, AssertionError)


def test_a_figure_is_there_whole_or_not_at_all(tmp_path: Path, full_disk: Callable[[str], None]) -> None:
    class Figure:
        def savefig(self, buffer: io.BytesIO, format: str, **_: object) -> None:
            buffer.write(format.encode())

    save_figure(Figure(), tmp_path / "new" / "a.svg")
    assert (tmp_path / "new" / "a.svg").read_bytes() == b"svg"
    full_disk("b.png")
    with pytest.raises(OutputError, match=r"b\.png"):
        save_figure(Figure(), tmp_path / "b.png")
    assert not (tmp_path / "b.png").exists()


def test_each_output_is_tried_and_the_failures_are_told_together() -> None:
    outputs, done = Outputs(), []
    with outputs.part("picture"):
        raise RuntimeError("no fonts")
    with outputs.part("page"):
        write_bytes_atomic(Path("/proc/page.html"), b"")
    with outputs.part("JSON"):
        done.append("JSON")
    with pytest.raises(OutputError, match=r"(?s)picture: RuntimeError: no fonts.*page: /proc/page\.html: cannot"):
        outputs.finish()
    assert done == ["JSON"]
    Outputs().finish()
