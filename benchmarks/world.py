"""(c) replay and (h) the emulated world in virtual time: times real time on one core, and growth with length."""

from __future__ import annotations

import json
import tempfile
import time
from collections.abc import Iterator, Mapping
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.row import Row, exponent, process_cpu_s
from firmware_py.app import run_in_process
from firmware_py.control.stages import StageConfigs, Stages
from firmware_py.frame import LAYOUT
from firmware_py.recording.reader import Recording
from firmware_py.recording.writer import RecordingWriter
from firmware_py.replay import replay_recording
from firmware_py.run_request import RunRequest
from hal.bench import load_bench
from tools.cli.bench_option import bench_path
from tools.closed_loop.simulate import SimulatedRun, simulate
from tools.reports.figures import tremor_figures

WIRE_S = 10.0
SIMULATED_S = (15.0, 60.0, 240.0)
REPLAY_S = (60.0, 300.0, 1800.0)
BLOCK = 100
SETTLE_NS = 2_000_000_000
AGREE = 0.1
"""The run without wires and the one over the wire may differ by so much in residual tremor: other noise samples."""


def left_um(truth: Mapping[str, Any], armed_ns: int, safe_ns: int) -> tuple[float, float]:
    """Tip tremor in 8-12 Hz without and with compensation, um rms."""
    scored = tremor_figures(truth, from_ns=armed_ns + SETTLE_NS, to_ns=safe_ns)
    assert scored is not None
    return scored.vector.uncompensated_rms_um, scored.vector.compensated_rms_um


@cache
def recorded_minute() -> tuple[str, np.ndarray]:
    """Frames of a simulated minute in closed loop, and the stage configuration they were made with."""
    bench = load_bench(bench_path(None))
    run = simulate(bench, REPLAY_S[0], keep_frames=True)
    assert run.frames is not None
    return json.dumps(run.configs.as_dict()), run.frames


def recording_of(seconds: float, path: Path) -> Recording:
    """The minute's scans again and again as one recording of ``seconds``, with the firmware's own answers."""
    text, frames = recorded_minute()
    stages = Stages(StageConfigs.from_dict(json.loads(text), "benchmark"))
    columns = list(zip(LAYOUT.scalar_names(), LAYOUT.scalar_units(), strict=True))
    writer = RecordingWriter(path, columns, {"stages": text, "tick_hz": "1000", "clock": "virtual"})
    total = round(1000 * seconds)
    for start in range(0, total, BLOCK):
        numbers = np.arange(start, min(start + BLOCK, total))
        rows = frames[numbers % len(frames)].copy()
        rows[:, 0], rows[:, 1] = numbers, numbers * 1e-3
        stages.run(rows)
        writer.write_block(start, rows)
    writer.finish({"ended": "stopped", "rows_pushed": total})
    return Recording(path)


def replay_rows() -> Iterator[Row]:
    costs = []
    with tempfile.TemporaryDirectory(prefix="micron-") as folder:
        for seconds in REPLAY_S:
            recording = recording_of(seconds, Path(folder) / f"{seconds:g}.mcap")
            started_s = time.process_time()
            report = replay_recording(recording)
            costs.append(time.process_time() - started_s)
            assert report.identical, report.first
            assert report.rows == 1000 * seconds
    took_s, seconds = costs[-1], REPLAY_S[-1]
    yield Row(
        "replay, 30 min at 1 kHz", "read, unpacked, recomputed and compared bit for bit; CPU of one process", took_s,
        seconds, "real time", "s", seconds / took_s, ">= 50 x", seconds >= 50.0 * took_s, must=True,
    )  # fmt: skip
    grows = exponent(REPLAY_S, costs)
    yield Row("replay, growth", "exponent of CPU over 1, 5, 30 min", grows, 1.0, "linear", "1", grows)


def wire_against_simulated() -> Iterator[Row]:
    path = bench_path(None)
    bench = load_bench(path)
    run_in_process(RunRequest(path, 0.5, pace="virtual"))
    simulate(bench, 0.5)
    started_s = time.process_time()
    outcome, truth = run_in_process(RunRequest(path, WIRE_S, pace="virtual"))
    wire_s = time.process_time() - started_s
    assert truth is not None
    without, over_wire = left_um(truth, outcome["armed_ns"], outcome["safe_ns"])
    costs: list[float] = []
    runs: list[SimulatedRun] = []
    for seconds in SIMULATED_S:
        costs.append(process_cpu_s(lambda seconds=seconds: runs.append(simulate(bench, seconds))))
    short = simulate(bench, WIRE_S)
    _, simulated = left_um(short.truth, short.armed_ns, short.safe_ns)
    seconds, took_s = SIMULATED_S[1], costs[1]
    yield Row(
        "closed loop, virtual time", "world and firmware in one compiled loop, no wires; CPU of one process", took_s,
        seconds, "real time", "s", seconds / took_s, ">= 20 x", seconds >= 20.0 * took_s, must=True,
    )  # fmt: skip
    yield Row(
        "closed loop, same tremor left", f"8-12 Hz at the tip, um rms; {without:.1f} without compensation", simulated,
        over_wire, "over the wire", "um", simulated / over_wire, f"within {AGREE:.0%}",
        abs(simulated / over_wire - 1.0) <= AGREE,
    )  # fmt: skip
    yield Row(
        "closed loop over the wire", "every byte of serial, I2C and CAN, in Python, virtual time", wire_s, WIRE_S,
        "real time", "s", WIRE_S / wire_s, "-", None,
    )  # fmt: skip
    grows = exponent(SIMULATED_S, costs)
    yield Row("closed loop, growth", "exponent of CPU over 15, 60, 240 s", grows, 1.0, "linear", "1", grows)


def rows() -> Iterator[Row]:
    yield from wire_against_simulated()
    yield from replay_rows()
