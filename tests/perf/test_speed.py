"""Nothing that was fast has become slow: CPU against a fixed compiled kernel in one process, never a wall clock."""

from __future__ import annotations

import pytest

from benchmarks import guard, step
from benchmarks.numpy_step import NumpyStep
from benchmarks.yardstick import Yardstick, compiler


def test_compiled_work_costs_what_it_did() -> None:
    late = guard.slower()
    assert not late, f"slower than {guard.MARGIN} x the stored ratio in {guard.ATTEMPTS} attempts: {late}"


def test_the_guard_sees_a_slow_step(monkeypatch: pytest.MonkeyPatch) -> None:
    """Twice the work is beyond the margin of what it costs here: processors differ by less, but by some of it."""
    real = guard.jobs
    here = min(guard.measure()["step"] for _ in range(2))

    def twice() -> dict:
        step = real()["step"]
        return {"step": lambda: (step(), step())}

    monkeypatch.setattr(guard, "jobs", twice)
    monkeypatch.setattr(guard.json, "loads", lambda _: {"step": here})
    monkeypatch.setattr(guard, "ATTEMPTS", 1)
    assert "step" in guard.slower()


def test_the_peers_of_the_step_compute_the_same() -> None:
    """Or the benchmark would compare different work; it stops there, and so does this."""
    n = 60
    ours, plain = step.Again(n), step.Again(n)
    ours.back().run(ours.work)
    step.feed(plain.stages, plain.work, NumpyStep(plain.back()).step)
    step.same(plain.work, ours.work, "numpy")
    if compiler() is not None:
        peer = step.Again(n)
        assert Yardstick(peer.back()).run(peer.work) == n
        step.same(peer.work, ours.work, "C", 1e-7)
        with pytest.raises(AssertionError, match="column"):
            step.same(peer.work * 1.001, ours.work, "C", 1e-7)
