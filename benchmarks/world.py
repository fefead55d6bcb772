"""The closed loop in virtual time, world included, and a replay of it: times real time."""

from __future__ import annotations

import tempfile
import time
from collections.abc import Iterator
from pathlib import Path

from benchmarks.row import Row
from firmware_py.app import RunRequest, run_in_process
from firmware_py.control.replay import replay_recording
from firmware_py.recording.reader import Recording
from tools.cli.bench_option import bench_path

SECONDS = 20.0


def rows() -> Iterator[Row]:
    bench = bench_path(None)
    run_in_process(RunRequest(bench, 1.0, virtual=True))
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "run.mcap"
        started_s = time.process_time()
        run_in_process(RunRequest(bench, SECONDS, virtual=True, record=path))
        loop_s = time.process_time() - started_s
        recording = Recording(path)
        started_s = time.process_time()
        report = replay_recording(recording)
        replay_s = time.process_time() - started_s
    assert report.identical
    for name, what, took_s, goal in (
        ("virtual loop", "closed loop with emulated world and wire, virtual time", loop_s, 20.0),
        ("replay", "the firmware over a recording, compared bit for bit", replay_s, 50.0),
    ):
        ratio = SECONDS / took_s
        yield Row(name, what, took_s, SECONDS, "real time", "s of CPU", ratio, f">= {goal:g} x", ratio >= goal)
