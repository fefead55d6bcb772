"""Describes what a run did, as JSON values: the part that every instrument has in common."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass
from typing import Any

from firmware_py.recording.recorder import RecordingSummary
from firmware_py.run.context import Run
from firmware_py.run.host_gaps import HostGaps
from firmware_py.run_request import RunRequest
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


@dataclass(frozen=True)
class Ending:
    """Holds what is known only when a run is over: real-time settings, the recorder's summary and the guardian's last
    report."""

    report: RealtimeReport
    recording: RecordingSummary | None
    guardian: Mapping[str, Any]


def make_outcome(
    request: RunRequest, opened: OpenBench, run: Run, identities: Mapping[str, str], ending: Ending
) -> dict[str, Any]:
    """Return the part of the run's JSON that every instrument has. ``identities``: the answers of the devices'
    probes. Times ending in ``_ns`` are on the bench clock."""
    snapshot = run.scheduler.snapshot()
    supervisor, counts, recording = run.supervisor, run.counts, ending.recording
    trip = supervisor.trip_cause
    return {
        "format": 1,
        "bench": opened.file.description.name,
        "clock": "virtual" if opened.virtual else "real",
        "seconds": request.seconds,
        "devices": dict(identities),
        "armed_ns": run.armed_ns,
        "safe_ns": trip.t_ns if trip is not None else None,
        "tasks": {task.name: task.as_dict() for task in snapshot.tasks},
        "ticks": {
            "run": snapshot.ticks,
            "caught_up": snapshot.caught_up,
            "skipped": snapshot.skipped_ticks,
            "duration_us": snapshot.tick_duration.as_dict(),
            "lateness_us": snapshot.tick_lateness.as_dict(),
            "announced": {item.reason: item.as_dict() for item in snapshot.ignored},
        },
        "samples": {
            "expected": counts.expected,
            "received": counts.received,
            "lost": counts.lost,
            "unread": counts.unread,
        },
        "noticed": dict(counts.noticed),
        "holds": run.incidents.holds.as_list(run.started_ns, run.clock.now_ns()),
        "guardian": run.guardian.describe() if run.guardian is not None else None,
        "warnings": dict(supervisor.warnings),
        "safe_state": _safe_state(run, ending.guardian),
        "loop": {"kind": "python"},
        "realtime": describe_scheduling(ending.report, opened.virtual),
        "recording": str(recording.path) if recording is not None else None,
        "recorder": {
            "ticks": recording.ticks if recording is not None else 0,
            "dropped": recording.dropped if recording is not None else 0,
            "problem": recording.problem if recording is not None else "",
        },
    }


def _safe_state(run: Run, guardian: Mapping[str, Any]) -> dict[str, Any]:
    """Return how the run ended. ``guardian``: the guardian's last report, which may have reached neutral in the
    firmware's place."""
    supervisor = run.supervisor
    trip = supervisor.trip_cause
    reason = trip.reason if trip is not None else "never left the boot state"
    reached, reached_ns = supervisor.safe_reached, run.safe_reached_ns
    if not reached and (guardian.get("neutral_ns") or 0) > (reached_ns or 0):
        reached, reached_ns = True, guardian["neutral_ns"]
        reason += f"; the firmware did not reach the outputs ({supervisor.ramp_failure}), but the guardian did"
    elif supervisor.ramp_failure:
        reason += f"; neutral NOT confirmed ({supervisor.ramp_failure}): switch the amplifier off"
    late_ms = None
    on_time = supervisor.safe_reached and not supervisor.was_late
    took_ms = (reached_ns - trip.t_ns) * 1e-6 if trip is not None and reached_ns and reached else 0.0
    if took_ms > 0.0 and not (on_time and took_ms <= (supervisor.ramp_ticks + 1) * run.period_ns * 1e-6):
        late_ms = took_ms
        reason += f"; neutral was confirmed only after {late_ms:.0f} ms"
    return {
        "reached": reached,
        "late_ms": late_ms,
        "reason": reason,
        "finding": trip.finding.name.lower() if trip is not None else None,
        "class": trip.cause.value if trip is not None else None,
        "normal": trip is not None and trip.normal and reached and on_time,
        "tick": trip.tick if trip is not None else -1,
        "asked_ns": run.asked_safe_ns,
        "reached_ns": reached_ns,
    }
