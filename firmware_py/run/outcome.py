"""Describes what a run did, as JSON values: the part that every instrument has in common."""

from __future__ import annotations

from dataclasses import asdict
from typing import Any

from firmware_py.run.host_gaps import HostGaps
from firmware_py.scheduler.realtime import RealtimeReport
from hal.bench import OpenBench
from hal.clock import PacedClock, VirtualClock


def describe_scheduling(report: RealtimeReport, virtual: bool) -> str:
    """Return the real-time settings that the loop ran with, in words."""
    if virtual:
        return "virtual time"
    if not report.settings:
        return "no real-time settings asked for"
    return ", ".join(s.wanted if s.done else f"no {s.wanted} ({s.detail})" for s in report.settings)


def describe_host(opened: OpenBench, gaps: HostGaps | None = None, cpu_share: float | None = None) -> dict[str, Any]:
    """Return how the host kept up with the run, as JSON values: pace, number of stalls, and longest stall.

    In real time these are the stalls of the loop (``gaps``) and of the emulated world, whichever is worse, and
    ``cpu_share`` is what this process used of one processor while the loop ran.
    """
    clock = opened.clock
    if isinstance(clock, PacedClock):
        return {"pace": "paced", **asdict(clock.report())}
    if isinstance(clock, VirtualClock):
        return {"pace": "virtual", "stalls": 0, "longest_stall_ms": 0.0}
    others = opened.world.stalls() if opened.world is not None else (0, 0.0)
    own = (gaps.stalls, gaps.longest_ms) if gaps is not None else (0, 0.0)
    stalls, longest_ms = max(own[0], others[0]), max(own[1], others[1])
    return {"pace": "realtime", "stalls": stalls, "longest_stall_ms": longest_ms, "cpu_share": cpu_share}
