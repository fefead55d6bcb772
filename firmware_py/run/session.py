"""Runs an instrument from its plan to its outcome: devices, guardian, recorder, page, loop, report."""

from __future__ import annotations

import contextlib
import json
import time
from collections.abc import Mapping
from typing import Any

from firmware_py.inject import Injector
from firmware_py.live.link import LiveLink
from firmware_py.recording.recorder import RecorderProcess
from firmware_py.recording.revision import git_revision
from firmware_py.run.context import Run, StatusSink
from firmware_py.run.guarded import guarded
from firmware_py.run.instrument import Instrument, InstrumentPlan, OpenedInstrument
from firmware_py.run.loop import Loop
from firmware_py.run.outcome import Ending, describe_host, make_outcome
from firmware_py.run.safety import SafetyLimits
from firmware_py.run_request import RunRequest, count_interrupts, describe_machine, scheduling
from hal.bench import BenchFile, OpenBench, is_emulated
from hal.clock import MonotonicClock


def run_plan(
    request: RunRequest,
    plan: InstrumentPlan,
    opened: OpenBench,
    on_status: StatusSink | None = None,
    injector: Injector | None = None,
    *,
    own_process: bool = False,
) -> tuple[Instrument, dict[str, Any]]:
    """Run ``plan`` on the opened bench. Return the instrument as it ended, and the outcome as JSON values.

    Raises ``HalError`` if the devices cannot be opened; later failures are in the outcome's ``safe_state``.
    ``injector`` has put faults around the ports. ``own_process``: this process is the firmware and nothing else, so the
    guardian may kill it.
    """
    with contextlib.ExitStack() as stack:
        parts = plan.open(opened)
        limits = apply_overrides(plan.safety, request)
        output = stack.enter_context(guarded(opened, parts.output, limits, may_be_killed=own_process))
        metadata = recording_metadata(plan.bench, parts, opened)
        recorder = None
        if request.record is not None:
            recorder = RecorderProcess.start(request.record, parts.columns, metadata)
        run = Run(
            opened.clock,
            1_000_000_000 // opened.file.description.clock.tick_hz,
            output=output.output,
            limits=limits,
            recorder=recorder,
            live=_open_link(request, opened, metadata, stack),
            on_status=on_status,
            guardian=output.lifecycle,
            sense_only=request.sense_only,
            other_stall_ms=opened.world.stalled_ms if opened.world is not None else None,
            allows_host_stalls=isinstance(opened.clock, MonotonicClock) and is_emulated(opened.file.description),
        )
        machine, summary, scheduled = describe_machine(opened), None, dict[str, Any]()
        interrupts = stack.enter_context(count_interrupts()) if own_process else lambda: 0
        try:
            instrument = parts.assemble(run)
            loop = Loop(run, instrument)
            _report_devices(run, loop, parts)
            try:
                with scheduling(request, opened) as report:
                    wall_s, cpu_s = time.monotonic(), time.process_time()
                    loop.run(request.seconds)
                    cpu_share = (time.process_time() - cpu_s) / max(time.monotonic() - wall_s, 1e-9)
            finally:
                scheduled = run.scheduler.snapshot().as_dict()
        finally:
            if recorder is not None:
                summary = recorder.stop(scheduled)
        takeover: Mapping[str, Any] = {}
        if output.lifecycle is not None:
            if late_ns := output.lifecycle.heartbeat.late_beat_ns:
                run.counts.noticed.setdefault("no command for a while (guardian)", late_ns)
            # before the emulated world ends, because the guardian may still have to ramp the outputs
            so_far = interrupts()
            takeover = output.lifecycle.stop(is_interrupted=lambda: interrupts() > so_far)
        outcome = make_outcome(request, opened, run, parts.identities, Ending(report, summary, takeover))
        outcome |= instrument.report()
        outcome["host"] = describe_host(opened, run.host_gaps, cpu_share)
        outcome["machine"] = machine
        if injector is not None:
            outcome["injected"] = injector.counts()
        return instrument, outcome


def _open_link(
    request: RunRequest, opened: OpenBench, metadata: Mapping[str, str], stack: contextlib.ExitStack
) -> LiveLink | None:
    """Open the link to the bench page, where the request has one, until ``stack`` closes it."""
    if request.live_fds is None:
        return None
    live = LiveLink(*request.live_fds)
    stack.callback(live.close)
    (opened.runtime_dir / "metadata.json").write_text(json.dumps(metadata))
    return live


def _report_devices(run: Run, loop: Loop, parts: OpenedInstrument) -> None:
    """Tell the page which devices there are, and the names of the histograms in its memory."""
    if run.on_status is not None and run.live is not None:
        run.on_status(
            {
                "event": "devices",
                "identities": parts.identities,
                "histograms": list(loop.histograms()),
                "has_outputs": run.output is not None,
            }
        )


def apply_overrides(limits: SafetyLimits, request: RunRequest) -> SafetyLimits:
    """Return the limits of the bench file with what the request overrides."""
    if request.stale_ms is None:
        return limits
    stalled_ms = max(request.stale_ms, limits.stalled_ms)
    return limits.model_copy(update={"stale_ms": request.stale_ms, "stalled_ms": stalled_ms})


def recording_metadata(bench: BenchFile, parts: OpenedInstrument, opened: OpenBench) -> dict[str, str]:
    """Return the metadata that a recording keeps about its run."""
    return {
        "bench": bench.text,
        "bench_name": bench.description.name,
        "git_revision": git_revision(),
        "clock": "virtual" if opened.virtual else "real",
        "tick_hz": str(bench.description.clock.tick_hz),
        **parts.metadata(),
    }
