"""Nothing that was fast has become slow: CPU against a fixed compiled kernel in one process, never a wall clock."""

from __future__ import annotations

import json

import pytest

from benchmarks import guard


def test_compiled_work_costs_what_it_did() -> None:
    late = guard.slower()
    assert not late, f"slower than {guard.MARGIN} x the stored ratio in {guard.ATTEMPTS} attempts: {late}"


def test_the_guard_sees_a_slow_step(monkeypatch: pytest.MonkeyPatch) -> None:
    """Twice the work is beyond the margin."""
    real = guard.jobs

    def twice() -> dict:
        step = real()["step"]
        return {"step": lambda: (step(), step())}

    stored = json.loads(guard.FILE.read_text())
    monkeypatch.setattr(guard, "jobs", twice)
    monkeypatch.setattr(guard.json, "loads", lambda _: {"step": stored["step"]})
    monkeypatch.setattr(guard, "ATTEMPTS", 1)
    assert "step" in guard.slower()
