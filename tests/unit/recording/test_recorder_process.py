"""The recorder as a real process: stop, both deaths, a full disk. Conditions are polled, times never asserted."""

from __future__ import annotations

import os
import resource
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
import pytest

from firmware_py.exit_codes import Exit
from firmware_py.recording.drain import RecorderState
from firmware_py.recording.errors import RecordingError
from firmware_py.recording.format import BLOCK_ROWS
from firmware_py.recording.reader import Recording
from firmware_py.recording.recorder import RecorderProcess
from tests.unit.recording.samples import COLUMNS, METADATA, make_rows, same_bits

pytestmark = pytest.mark.realtime
PRODUCER = Path(__file__).with_name("producer.py")
ROOT = Path(__file__).parents[3]


def wait_for(condition: Callable[[], bool], what: str, limit_s: float = 60.0) -> None:
    deadline_s = time.monotonic() + limit_s
    while not condition():
        assert time.monotonic() < deadline_s, f"waited in vain for: {what}"
        time.sleep(0.005)


def test_a_stopped_recording_is_complete(tmp_path: Path) -> None:
    rows = make_rows(1234)
    path = tmp_path / "run.mcap"
    recorder = RecorderProcess.start(path, COLUMNS, METADATA)
    for i, row in enumerate(rows):
        assert recorder.push(row)
        if i == 600:
            assert recorder.event({"event": "half", "t_ns": 5, "value": float("nan"), "state": np.float64(2.0)})
    summary = recorder.stop({"tasks": {"sense": {"runs": 1234}}})
    assert (summary.ticks, summary.dropped, summary.exit_code, summary.problem) == (1234, 0, 0, "")
    assert summary.exit_code == 0
    assert summary.size_bytes == path.stat().st_size
    assert recorder.stop() is summary
    recording = Recording(path)
    assert same_bits(recording.array(recording.names), rows)
    assert recording.events[0].content == {"event": "half", "t_ns": 5, "value": None, "state": 2.0}
    assert recording.metadata["statistics"] == {"tasks": {"sense": {"runs": 1234}}}
    assert recording.metadata["bench"] == METADATA["bench"]
    assert not recording.health.lost


def test_the_producer_never_waits_and_drops_are_exact(tmp_path: Path) -> None:
    rows = make_rows(500)
    recorder = RecorderProcess.start(tmp_path / "run.mcap", COLUMNS, {}, capacity_rows=64)
    os.kill(recorder.pid, signal.SIGSTOP)  # a recorder that cannot run
    try:
        taken = [recorder.push(row) for row in rows]
    finally:
        os.kill(recorder.pid, signal.SIGCONT)
    wait_for(lambda: recorder.stats().waiting == 0, "the ring is empty again")
    kept = [i for i, t in enumerate(taken) if t]
    assert recorder.stats().dropped == 500 - len(kept)
    assert len(kept) >= 64
    summary = recorder.stop()
    assert (summary.ticks, summary.dropped) == (len(kept), 500 - len(kept))
    assert summary.exit_code == Exit.DATA_LOST
    recording = Recording(tmp_path / "run.mcap")
    assert recording.row_numbers().tolist() == kept
    assert recording.health.dropped == recording.health.missing_rows == 500 - len(kept)


def test_virtual_time_waits_instead_of_dropping(tmp_path: Path) -> None:
    rows = make_rows(3000)
    recorder = RecorderProcess.start(tmp_path / "run.mcap", COLUMNS, {"clock": "virtual"}, capacity_rows=256)
    assert all(recorder.push(row) for row in rows)
    assert recorder.stop().ticks == 3000
    assert same_bits(Recording(tmp_path / "run.mcap").array([n for n, _ in COLUMNS]), rows)


def test_a_killed_recorder_loses_only_what_was_not_written(tmp_path: Path) -> None:
    rows = make_rows(5000)
    path = tmp_path / "run.mcap"
    recorder = RecorderProcess.start(path, COLUMNS, METADATA)
    pushed = 0
    while recorder.stats().written < 1000:
        if recorder.stats().waiting < 20:
            recorder.push(rows[pushed])
            pushed += 1
    os.kill(recorder.pid, signal.SIGKILL)
    wait_for(lambda: not recorder.stats().alive, "the recorder is dead")
    left_in_ring = recorder.stats().waiting
    recorder.push(rows[0])  # the loop goes on as if nothing had happened
    recording = Recording(path)
    assert same_bits(recording.array(recording.names), rows[: recording.n_rows])
    assert pushed - recording.n_rows <= left_in_ring + BLOCK_ROWS
    assert recording.health.lost
    assert "killed" in "\n".join(recording.health.lines())
    summary = recorder.stop()
    assert summary.exit_code == -signal.SIGKILL
    assert "signal 9" in summary.problem


@pytest.fixture
def producer(tmp_path: Path) -> Iterator[subprocess.Popen[str]]:
    process = subprocess.Popen(
        [sys.executable, str(PRODUCER), str(tmp_path / "run.mcap")],
        stdout=subprocess.PIPE,
        text=True,
        env={**os.environ, "PYTHONPATH": str(ROOT)},
    )
    yield process
    process.kill()
    process.communicate()


def test_a_killed_firmware_loses_nothing_that_it_pushed(producer: subprocess.Popen[str], tmp_path: Path) -> None:
    assert producer.stdout is not None
    recorder_pid = int(producer.stdout.readline())
    pushed = 0
    while pushed < 300:
        pushed = int(producer.stdout.readline())
    producer.kill()
    producer.wait()
    pushed = max([pushed, *map(int, producer.stdout.read().split())])
    path = tmp_path / "run.mcap"
    wait_for(lambda: Recording(path).health.finished, f"recorder {recorder_pid} closes the file")
    recording = Recording(path)
    health = recording.health
    assert recording.n_rows >= pushed
    assert health.missing_rows == health.missing_events == 0
    assert recording.column("tick").tolist() == list(range(recording.n_rows))
    assert [e.content["event"] for e in recording.events] == ["early"]
    assert health.ended == "the firmware ended without closing the recording"
    assert "ended early" in "\n".join(health.lines())


def test_a_terminated_recorder_closes_the_file(tmp_path: Path) -> None:
    recorder = RecorderProcess.start(tmp_path / "run.mcap", COLUMNS, {})
    for row in make_rows(150):
        recorder.push(row)
    os.kill(recorder.pid, signal.SIGTERM)
    wait_for(lambda: not recorder.stats().alive, "the recorder ends")
    assert recorder.stop().ticks == 150
    assert Recording(tmp_path / "run.mcap").health.ended == "the recorder was terminated"


def fill(recorder: RecorderProcess) -> np.ndarray:
    """Push rows until the recorder gives up; all rows that were offered."""
    offered = []
    rows = make_rows(100_000)
    for row in rows:
        stats = recorder.stats()
        if not stats.alive:
            break
        if stats.waiting > 500:
            time.sleep(0.001)
        recorder.push(row)
        offered.append(row)
    wait_for(lambda: not recorder.stats().alive, "the recorder ends")
    return np.array(offered)


def test_a_file_size_limit_is_said_and_the_data_before_are_intact(tmp_path: Path) -> None:
    path = tmp_path / "run.mcap"
    recorder = RecorderProcess.start(path, COLUMNS, METADATA)
    resource.prlimit(recorder.pid, resource.RLIMIT_FSIZE, (60_000, 60_000))
    offered = fill(recorder)
    assert recorder.stats().state is RecorderState.DISK_FULL
    summary = recorder.stop({})
    assert summary.exit_code == Exit.DATA_LOST
    assert "the disk is full" in summary.problem
    recording = Recording(path)
    assert 500 < recording.n_rows == summary.ticks
    assert summary.dropped == len(offered) - recording.n_rows
    assert same_bits(recording.array(recording.names), offered[: recording.n_rows])
    assert not recording.health.damage
    assert recording.health.lost


def test_a_full_disk_is_said_in_the_file_too(tmp_path: Path) -> None:
    disk = tmp_path / "disk"
    disk.mkdir()
    mounted = subprocess.run(
        ["mount", "-t", "tmpfs", "-o", "size=256k", "tmpfs", str(disk)], capture_output=True, check=False
    )
    if mounted.returncode != 0:
        pytest.skip(f"cannot mount a small file system here: {mounted.stderr.decode().strip()}")
    try:
        path = disk / "run.mcap"
        recorder = RecorderProcess.start(path, COLUMNS, METADATA)
        offered = fill(recorder)
        summary = recorder.stop({})
        assert (summary.exit_code, recorder.path) == (Exit.DATA_LOST, path)
        recording = Recording(path)
        assert same_bits(recording.array(recording.names), offered[: recording.n_rows])
        assert recording.n_rows > 1000
        assert recording.health.ended == "disk full"
        assert "the disk is full" in recording.events[-1].content["reason"]
        assert not recording.health.damage
        assert {k: recording.metadata[k] for k in METADATA} == METADATA
    finally:
        subprocess.run(["umount", str(disk)], check=True)


def test_a_place_that_cannot_be_written_is_one_clear_error(tmp_path: Path) -> None:
    with pytest.raises(RecordingError, match="cannot be written"):
        RecorderProcess.start(tmp_path / "nowhere" / "run.mcap", COLUMNS, {})
    existing = tmp_path / "run.mcap"
    existing.write_bytes(b"precious")
    with pytest.raises(RecordingError, match="exists already"):
        RecorderProcess.start(existing, COLUMNS, {})
    assert existing.read_bytes() == b"precious"


def test_overwriting_is_possible_when_asked(tmp_path: Path) -> None:
    path = tmp_path / "run.mcap"
    path.write_bytes(bytes(100_000))
    recorder = RecorderProcess.start(path, COLUMNS, {}, overwrite=True)
    recorder.push(make_rows(1)[0])
    assert recorder.stop().ticks == 1
    assert Recording(path).n_rows == 1
