"""Reads what every run shows while it lasts: a few numbers for the terminal, the histograms for the page."""

from __future__ import annotations

from firmware_py.run.context import Run
from firmware_py.scheduler.histogram import DurationHistogram


def collect_numbers(run: Run) -> dict[str, object]:
    """Return the status as JSON values, under the names of the bench page. ``t_s`` counts from the start of the run."""
    now_ns, supervisor, counts = run.clock.now_ns(), run.supervisor, run.counts
    latency = counts.latency.distribution()
    return {
        **(_page_numbers(run, now_ns) if run.live is not None else {}),
        "t_s": (now_ns - run.started_ns) * 1e-9,
        "state": supervisor.state.words,
        "holds": len(supervisor.holds),
        "hold": run.incidents.holds.as_status(now_ns),
        "latency_us": [latency.p50_us, latency.p99_us],
        "lost": counts.lost,
        "skipped": run.scheduler.skipped_ticks,
    }


def _page_numbers(run: Run, now_ns: int) -> dict[str, object]:
    trip, counts = run.supervisor.trip_cause, run.counts
    return {
        "now_ns": now_ns,
        "reason": trip.reason if trip is not None else "",
        "samples": counts.received,
        "commands": counts.commands,
        "clipped": counts.clipped,
        "tasks": run.scheduler.task_counts(),
    }


def collect_histograms(run: Run, own: dict[str, DurationHistogram]) -> dict[str, DurationHistogram]:
    """Return every live histogram, those of the instrument (``own``) first."""
    return {**own, **run.scheduler.histograms()}
