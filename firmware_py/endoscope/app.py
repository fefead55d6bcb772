"""Runs an endoscope bench: opens it, runs the loop and reports what happened. ``firmware_py.app`` calls it."""

from __future__ import annotations

import contextlib
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from firmware_py.endoscope.config import EndoscopeConfig, load_endoscope_config
from firmware_py.endoscope.loop import FRAME, EndoscopeLoop
from firmware_py.endoscope.report import experiment
from firmware_py.endoscope.targets import GameState
from firmware_py.endoscope.wiring import open_sensors
from firmware_py.recording.recorder import RecorderProcess, RecordingSummary
from firmware_py.recording.revision import git_revision
from firmware_py.run.outcome import describe_host, describe_scheduling
from firmware_py.run_request import (
    RunRequest,
    count_interrupts,
    open_requested,
    scheduling,
    truth_of,
)
from firmware_py.sensing.fusion import Fusion
from hal.bench import BenchFile, OpenBench, Port
from hal.contracts import Clock

StateSink = Callable[[GameState, int], None]


def run_request(
    request: RunRequest,
    bench: BenchFile,
    on_status: Callable[[dict[str, Any]], None] | None,
    runtime_dir: Path | None,
    on_open: Callable[[OpenBench], None] | None,
    wrap: Callable[[str, Port, Clock], Port] | None = None,
    *,
    own_process: bool = False,
) -> tuple[dict[str, Any], dict[str, Any] | None]:
    """Run an endoscope bench in this process, as ``firmware_py.app.run_in_process`` runs an instrument. Return the
    outcome (JSON values) and the truth of an emulated world."""
    config = load_endoscope_config(bench)  # before a device is touched
    with open_requested(request, bench, runtime_dir, wrap) as opened:
        if on_open is not None:
            on_open(opened)
        _, outcome = run_endoscope(request, bench, opened, on_status, config=config, own_process=own_process)
        return outcome, truth_of(opened)


def run_endoscope(
    request: RunRequest,
    bench: BenchFile,
    opened: OpenBench,
    on_status: Callable[[dict[str, Any]], None] | None,
    *,
    config: EndoscopeConfig | None = None,
    on_state: StateSink | None = None,
    until_done: bool = False,
    own_process: bool = False,
) -> tuple[EndoscopeLoop, dict[str, Any]]:
    """Run on an opened bench. Return the finished loop and the outcome for JSON. ``config`` overrides the bench's.

    Raises ``HalError`` when the devices cannot be opened; what goes wrong later is in ``safe_state``.
    """
    config = config or load_endoscope_config(bench)
    sensors = open_sensors(opened)
    recorder = _recorder(request, bench, config, opened)
    summary: RecordingSummary | None = None
    try:
        for sensor in sensors.by_name.values():  # compile before the first sample is due
            Fusion(config.fusion, sensor.rate_hz).step(np.zeros(3), np.array([0.0, 0.0, 9.8]))
        loop = EndoscopeLoop(
            sensors,
            config,
            opened.clock,
            tick_hz=bench.description.clock.tick_hz,
            recorder=recorder,
            on_status=on_status,
            on_state=on_state,
        )
        telling = count_interrupts() if own_process else contextlib.nullcontext()
        with telling, scheduling(request, opened) as report:
            loop.run(request.seconds, until_done=until_done)
    finally:
        if recorder is not None:
            summary = recorder.stop({})
    outcome = make_outcome(request, opened, loop, sensors.identities, summary)
    return loop, {
        **outcome,
        "host": describe_host(opened),
        "realtime": describe_scheduling(report, opened.virtual),
    }


def _recorder(
    request: RunRequest, bench: BenchFile, config: EndoscopeConfig, opened: OpenBench
) -> RecorderProcess | None:
    if request.record is None:
        return None
    metadata = {
        "bench": bench.text,
        "bench_name": bench.description.name,
        "endoscope": config.model_dump_json(),
        "git_revision": git_revision(),
        "clock": "virtual" if opened.virtual else "real",
        "tick_hz": str(bench.description.clock.tick_hz),
    }
    return RecorderProcess.start(request.record, FRAME, metadata)


def make_outcome(
    request: RunRequest,
    opened: OpenBench,
    loop: EndoscopeLoop,
    identities: dict[str, str],
    recording: RecordingSummary | None,
) -> dict[str, Any]:
    """Return the run's JSON as far as the firmware knows it."""
    snapshot = loop.scheduler.snapshot()
    ran_s = ((loop.ended_ns or loop.started_ns) - loop.started_ns) * 1e-9
    state = loop.game.state()
    sensors = {
        name: {
            "rate_hz": track.sensor.rate_hz,
            "expected": round(ran_s * track.sensor.rate_hz),
            "received": track.received,
            "used": track.used,
            "lost": track.sensor.lost,
            "masked": track.sensor.masked,
            "bad_frames": track.sensor.bad_frames,
        }
        for name, track in loop.tracks.items()
    }
    return {
        "format": 1,
        "instrument": "endoscope",
        "bench": opened.file.description.name,
        "clock": "virtual" if opened.virtual else "real",
        "seconds": request.seconds,
        "ran_s": ran_s,
        "devices": identities,
        "steered_by": loop.steering.sensor.name,
        "tasks": {task.name: task.as_dict() for task in snapshot.tasks},
        "ticks": {
            "run": snapshot.ticks,
            "skipped": snapshot.skipped_ticks,
            "duration_us": snapshot.tick_duration.as_dict(),
            "lateness_us": snapshot.tick_lateness.as_dict(),
        },
        "latency": {"arrival_to_view_us": loop.latency.distribution().as_dict()},
        "sensors": sensors,
        "samples": {key: sum(s[key] for s in sensors.values()) for key in ("expected", "received", "lost")},
        "fusion": loop.config.fusion.model_dump(),
        "attitudes": {name: [list(row) for row in track.history] for name, track in loop.tracks.items()},
        "view": {"status": state.status, "x": state.view.x, "y": state.view.y, "size": state.view.size},
        "experiment": experiment(loop.game),
        "safe_state": {"reached": True, "reason": loop.reason, "normal": loop.normal},
        "recording": str(recording.path) if recording is not None else None,
        "recorder": {"ticks": recording.ticks, "dropped": recording.dropped, "problem": recording.problem}
        if recording
        else {"ticks": 0, "dropped": 0, "problem": ""},
    }
