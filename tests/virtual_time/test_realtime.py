"""Real-time settings: tried, reported, undone; never an exception when they are not permitted."""

from __future__ import annotations

import ctypes
import gc
import os

import pytest

from firmware_py.scheduler import RealtimeConfig, realtime

EVERYTHING = RealtimeConfig(priority=1, lock_memory=True, cpu=0, timer_slack_ns=1, freeze_gc=True)


def state() -> tuple[object, ...]:
    slack_ns = ctypes.CDLL(None).prctl(30, 0, 0, 0, 0)
    with open("/proc/self/status") as status:
        locked = next(line for line in status if line.startswith("VmLck"))
    return (
        os.sched_getscheduler(0),
        os.sched_getaffinity(0),
        gc.isenabled(),
        gc.get_freeze_count() > 0,
        slack_ns,
        locked,
    )


def test_everything_is_undone() -> None:
    before = state()
    with realtime(EVERYTHING) as report:
        assert [s.name for s in report.settings] == ["cpu", "timer_slack", "lock_memory", "gc", "priority"]
        assert report["gc"].done
        assert not gc.isenabled()
        if report["priority"].done:
            assert os.sched_getscheduler(0) & 0xFF == os.SCHED_FIFO
        if report["cpu"].done:
            assert os.sched_getaffinity(0) == {0}
    assert state() == before


def test_undone_after_an_exception() -> None:
    before = state()
    with pytest.raises(KeyError), realtime(EVERYTHING):
        raise KeyError
    assert state() == before


def test_what_is_refused_is_data(monkeypatch: pytest.MonkeyPatch) -> None:
    def refuse(*_: object) -> None:
        raise PermissionError(1, "Operation not permitted")

    monkeypatch.setattr(os, "sched_setscheduler", refuse)
    monkeypatch.delattr(os, "sched_setaffinity")
    with realtime(RealtimeConfig(priority=99, cpu=0, lock_memory=False)) as report:
        assert not report["priority"].done
        assert "CAP_SYS_NICE" in report["priority"].detail
        assert not report["cpu"].done
        assert "not offered" in report["cpu"].detail
        assert report["gc"].done


def test_an_impossible_cpu_is_said() -> None:
    with realtime(RealtimeConfig(priority=None, cpu=4095, lock_memory=False, freeze_gc=False)) as report:
        assert not report["cpu"].done


def test_nothing_asked_nothing_done() -> None:
    off = RealtimeConfig(priority=None, lock_memory=False, cpu=None, timer_slack_ns=None, freeze_gc=False)
    with realtime(off) as report:
        assert report.as_dict() == {}
