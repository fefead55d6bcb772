"""The rate of a recording is what its run wrote: metadata of a file are texts."""

from __future__ import annotations

from pathlib import Path

from firmware_py.app import run_in_process
from firmware_py.recording.reader import Recording
from firmware_py.replay import replay_recording
from firmware_py.run_request import RunRequest
from tests.conftest import DEFAULT_BENCH


def test_a_recorded_run_has_its_rate_and_replays(tmp_path: Path) -> None:
    run_in_process(RunRequest(DEFAULT_BENCH, 0.5, pace="virtual", record=tmp_path / "run.mcap"))
    recording = Recording(tmp_path / "run.mcap")
    assert recording.tick_hz == 1000.0
    assert replay_recording(recording).identical
