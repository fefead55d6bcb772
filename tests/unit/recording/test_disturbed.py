"""Another program deletes, replaces, cuts, writes or moves the file under the recorder, or wants to record into it."""

from __future__ import annotations

import os
import re
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from firmware_py.exit_codes import Exit
from firmware_py.recording.drain import RecorderState
from firmware_py.recording.errors import RecordingError
from firmware_py.recording.files import is_being_recorded
from firmware_py.recording.reader import Recording
from firmware_py.recording.recorder import RecorderProcess
from firmware_py.recording.recover import recover
from firmware_py.recording.writer import FileDisturbed, RecordingWriter
from tests.unit.recording.samples import COLUMNS, make_rows, same_bits

Blow = Callable[[Path], None]


def delete(path: Path) -> None:
    path.unlink()


def replace(path: Path) -> None:
    other = path.with_name("other")
    other.write_bytes(b"something else")
    os.replace(other, path)


def cut(path: Path) -> None:
    os.truncate(path, path.stat().st_size // 2)


def empty(path: Path) -> None:
    path.write_bytes(b"")


def append(path: Path) -> None:
    with path.open("ab") as file:
        file.write(b"more")


BLOWS: list[tuple[Blow, str]] = [
    (delete, "the file was deleted while it was recorded"),
    (replace, "the file was replaced by another file while it was recorded"),
    (cut, r"the file was cut to \d+ of \d+ bytes while it was recorded"),
    (empty, r"the file was cut to 0 of \d+ bytes while it was recorded"),
    (append, "the file was written by another program as well while it was recorded"),
]


@pytest.mark.parametrize(("blow", "says"), BLOWS)
@pytest.mark.parametrize("at_the_end", [False, True])
def test_the_writer_notices_by_inode_and_size(tmp_path: Path, blow: Blow, says: str, at_the_end: bool) -> None:
    path = tmp_path / "run.mcap"
    writer = RecordingWriter(path, COLUMNS, {})
    for start in range(0, 1000, 100):
        writer.write_block(start, make_rows(1000)[start : start + 100])
        writer.check()
    blow(path)
    left = path.read_bytes() if path.exists() else None
    with pytest.raises(FileDisturbed, match=says):
        writer.finish({}) if at_the_end else writer.check()
    writer.abandon()
    assert (path.read_bytes() if path.exists() else None) == left  # what others made is not touched


def test_a_moved_file_is_whole_under_its_new_name(tmp_path: Path) -> None:
    path, moved = tmp_path / "run.mcap", tmp_path / "moved.mcap"
    writer = RecordingWriter(path, COLUMNS, {})
    writer.write_block(0, make_rows(100))
    path.rename(moved)
    writer.check()
    writer.write_block(100, make_rows(200)[100:])
    writer.finish({"ended": "stopped", "rows_pushed": 200})
    assert writer.moved
    assert not Recording(moved).health.lost


def test_one_recorder_at_a_time(tmp_path: Path) -> None:
    path = tmp_path / "run.mcap"
    writer = RecordingWriter(path, COLUMNS, {})
    writer.write_block(0, make_rows(100))
    written = path.read_bytes()
    assert is_being_recorded(path)
    assert "it is being recorded now" in "\n".join(Recording(path).health.lines())
    with pytest.raises(RecordingError, match="is being recorded by another process; stop it or choose another name"):
        RecordingWriter(path, COLUMNS, {}, overwrite=True)
    source = tmp_path / "source.mcap"
    other = RecordingWriter(source, COLUMNS, {})
    other.finish({"ended": "stopped", "rows_pushed": 0})
    with pytest.raises(RecordingError, match="is being recorded by another process"):
        recover(source, path, overwrite=True)
    assert path.read_bytes() == written  # neither has cut it
    writer.finish({"ended": "stopped", "rows_pushed": 100})
    assert not is_being_recorded(path)
    RecordingWriter(path, COLUMNS, {}, overwrite=True).finish({"ended": "stopped", "rows_pushed": 0})
    assert Recording(path).n_rows == 0
    assert "killed" not in "\n".join(Recording(path).health.lines())


def wait_for(condition: Callable[[], bool], what: str, limit_s: float = 60.0) -> None:
    deadline_s = time.monotonic() + limit_s
    while not condition():
        assert time.monotonic() < deadline_s, f"waited in vain for: {what}"
        time.sleep(0.005)


def started(path: Path, n: int = 300) -> RecorderProcess:
    recorder = RecorderProcess.start(path, COLUMNS, {})
    for row in make_rows(n):
        recorder.push(row)
    wait_for(lambda: recorder.stats().written == n, "all rows are written")
    return recorder


@pytest.mark.realtime
@pytest.mark.parametrize(("blow", "says"), [b for b in BLOWS if b[0] is not empty])
@pytest.mark.parametrize("at_the_end", [False, True])
def test_the_recorder_says_so(tmp_path: Path, blow: Blow, says: str, at_the_end: bool) -> None:
    """While it records, by itself; or when it is stopped right after."""
    path = tmp_path / "run.mcap"
    recorder = started(path)
    blow(path)
    if not at_the_end:
        wait_for(lambda: recorder.stats().state is RecorderState.DISTURBED, "the recorder has noticed")
        wait_for(lambda: not recorder.stats().alive, "the recorder has ended")
        recorder.push(np.zeros(5))
    summary = recorder.stop({"ticks": 300})
    assert summary.exit_code == Exit.DATA_LOST
    assert re.search(says, summary.problem), summary.problem
    in_file = Recording(path).n_rows if blow in (cut, append) and _readable(path) else 0
    assert summary.ticks == in_file
    assert summary.dropped == 300 - in_file + (not at_the_end)
    if blow is cut and not at_the_end:
        recording = Recording(path)
        assert same_bits(recording.array(recording.names), make_rows(300)[: recording.n_rows])
        assert f"{recording.n_rows} ticks are left in it" in summary.problem


def _readable(path: Path) -> bool:
    try:
        Recording(path)
    except RecordingError:
        return False
    return True


@pytest.mark.realtime
def test_a_moved_recording_is_complete_and_it_is_said(tmp_path: Path) -> None:
    path = tmp_path / "run.mcap"
    recorder = started(path)
    path.rename(tmp_path / "moved.mcap")
    summary = recorder.stop()
    assert (summary.ticks, summary.dropped, summary.exit_code) == (300, 0, Exit.DONE)
    assert summary.problem.endswith("the file was moved while it was recorded; it is whole under its new name")
    assert not Recording(tmp_path / "moved.mcap").health.lost


@pytest.mark.realtime
def test_a_second_recorder_is_refused_and_the_first_one_goes_on(tmp_path: Path) -> None:
    path = tmp_path / "run.mcap"
    recorder = started(path)
    for overwrite, says in ((False, "exists already"), (True, "is being recorded by another process")):
        with pytest.raises(RecordingError, match=says):
            RecorderProcess.start(path, COLUMNS, {}, overwrite=overwrite)
    summary = recorder.stop()
    assert summary.exit_code == 0
    assert not Recording(path).health.lost
