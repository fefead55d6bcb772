"""The firmware's process, from the request that it is handed to the files that it leaves. In this process, virtual."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from firmware_py import app
from firmware_py.run.outcome import describe_scheduling
from firmware_py.run_request import RunRequest
from firmware_py.scheduler.realtime import RealtimeReport, Setting
from tests.conftest import DEFAULT_BENCH, copy_of_default_bench


@pytest.fixture
def told(monkeypatch: pytest.MonkeyPatch) -> list[dict[str, object]]:
    """What the process says while it runs; it is not tied to the life of a parent here."""
    lines: list[dict[str, object]] = []
    monkeypatch.setattr(app, "_die_with_parent", lambda: None)
    monkeypatch.setattr(app, "_status_pipe", lambda: lambda status: lines.append(dict(status)))
    return lines


def start(request: RunRequest, folder: Path) -> int:
    (folder / "request.json").write_text(request.to_json(folder))
    return app.main([str(folder / "request.json")])


def test_outcome_and_truth_are_left_where_the_request_says(tmp_path: Path, told: list[dict[str, object]]) -> None:
    assert start(RunRequest(DEFAULT_BENCH, 0.3, pace="virtual", seed=4), tmp_path) == 0
    outcome = json.loads((tmp_path / "outcome.json").read_text())
    assert outcome["samples"]["lost"] == 0
    assert outcome["safe_state"]["normal"]
    assert told
    with np.load(tmp_path / "truth.npz") as truth:
        assert len(truth["stroke_m"]) > 300


def test_a_bench_that_cannot_be_is_one_line_and_status_2(
    tmp_path: Path, told: list[dict[str, object]], capsys: pytest.CaptureFixture[str]
) -> None:
    bench = copy_of_default_bench(tmp_path, "")
    bench.write_text(bench.read_text().replace("rate_hz = 1000", "rate_hz = 500"))
    assert start(RunRequest(bench, 0.3, pace="virtual"), tmp_path) == 2
    said = capsys.readouterr().err
    assert said.startswith("micron: ")
    assert len(said.splitlines()) == 1
    assert "1000 Hz" in said
    assert not (tmp_path / "outcome.json").exists()


def test_scheduling_is_told_as_it_was_granted() -> None:
    report = RealtimeReport(
        [Setting("policy", "SCHED_FIFO 80", True), Setting("memory", "locked memory", False, "EPERM")]
    )
    assert describe_scheduling(report, virtual=False) == "SCHED_FIFO 80, no locked memory (EPERM)"
    assert describe_scheduling(RealtimeReport(), virtual=False) == "no real-time settings asked for"
    assert describe_scheduling(report, virtual=True) == "virtual time"
