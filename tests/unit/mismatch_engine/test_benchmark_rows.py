"""The rows of the engine's benchmark: the longest recording is left out, and that is said, when the machine is busy."""

from __future__ import annotations

import math
from types import SimpleNamespace

import pytest

from benchmarks import mismatch
from benchmarks.row import Row


def rows_of(monkeypatch: pytest.MonkeyPatch, wall_per_recorded_s: float) -> dict[str, Row]:
    """All rows when a diagnosis costs 0.1 s of CPU a second of recording and the given wall time."""
    now_s = 0.0

    def measured(seconds: float, jobs: int, make: object = None) -> tuple[float, float, int]:
        nonlocal now_s
        now_s += wall_per_recorded_s * seconds
        return wall_per_recorded_s * seconds / jobs, 0.1 * seconds, 40

    monkeypatch.delenv("MICRON_BENCH_LONG", raising=False)
    monkeypatch.setattr(mismatch, "measure", measured)
    monkeypatch.setattr(mismatch, "column_s", lambda order, inputs, outputs: (0.02, 51))
    monkeypatch.setattr(mismatch, "peers", lambda recording: iter(()))
    monkeypatch.setattr(mismatch, "stack_recording", lambda seconds: None)
    monkeypatch.setattr(mismatch, "time", SimpleNamespace(perf_counter=lambda: now_s))
    return {row.name: row for row in mismatch.rows()}


def test_all_lengths_on_a_free_machine(monkeypatch: pytest.MonkeyPatch) -> None:
    rows = rows_of(monkeypatch, 0.1)
    growth = rows["mismatch, growth with length"]
    assert "1800 s: 180.0" in growth.what
    assert math.isclose(growth.ours, 1.0, abs_tol=1e-9)
    assert rows["mismatch, 60 s at 1 kHz, axis with friction"].meets is True


def test_the_longest_is_left_out_on_a_busy_machine(monkeypatch: pytest.MonkeyPatch) -> None:
    rows = rows_of(monkeypatch, 1.0)
    growth = rows["mismatch, growth with length"]
    assert "1800 s left out" in growth.what
    assert "1800 s: " not in growth.what
    minute = rows["mismatch, 60 s at 1 kHz, stack"]
    assert minute.ours == 30.0  # a minute over two processes
    assert minute.meets is True
