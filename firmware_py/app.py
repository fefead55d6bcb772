"""Runs the firmware as a program: it opens the bench, runs the loop and reports what happened.

``run_in_process`` is the whole of it; ``python -m firmware_py.app REQUEST.json`` is the same in a process of
its own, for real time, with status lines on standard output that are dropped rather than waited for.
"""

from __future__ import annotations

import contextlib
import ctypes
import json
import os
import signal
import sys
import time
from collections.abc import Callable, Mapping
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from firmware_py.control.guarded import guarded
from firmware_py.control.loop import InstrumentLoop
from firmware_py.control.plan import load_plan
from firmware_py.control.stages import StageConfigs, Stages
from firmware_py.control.wiring import Devices, open_devices
from firmware_py.endoscope.wiring import is_endoscope
from firmware_py.exit_codes import exit_code_of
from firmware_py.frame import LAYOUT
from firmware_py.inject import Injector, check_injections, parse_injection
from firmware_py.live.link import LiveLink
from firmware_py.recording.recorder import RecorderProcess, RecordingSummary
from firmware_py.recording.revision import git_revision
from firmware_py.run.outcome import describe_host, describe_scheduling
from firmware_py.run.safety import RAMP_TICKS
from firmware_py.run_request import (
    RunRequest,
    count_interrupts,
    describe_machine,
    open_requested,
    scheduling,
    truth_of,
)
from firmware_py.scheduler.realtime import RealtimeReport
from hal.bench import BenchFile, OpenBench, Port, load_bench
from hal.contracts import Clock
from hal.errors import HalError

StatusSink = Callable[[dict[str, Any]], None]


def run_in_process(
    request: RunRequest,
    on_status: StatusSink | None = None,
    runtime_dir: Path | None = None,
    on_open: Callable[[OpenBench], None] | None = None,
    wrap: Callable[[str, Port, Clock], Port] | None = None,
    *,
    own_process: bool = False,
) -> tuple[dict[str, Any], dict[str, Any] | None]:
    """Run the instrument; returns the outcome (JSON values) and, from an emulated world, the truth.

    Raises ``HalError`` when the bench cannot be opened. What goes wrong later is in the outcome's
    ``safe_state``; a world that died leaves no truth. ``on_open`` may prepare the bench before its devices are
    opened, ``wrap`` put middleware around its ports (fault tests). ``own_process``: this process is the firmware and
    nothing else; the guardian may kill it where it stands still in the middle of a command.
    """
    bench = load_bench(request.bench)
    injections = [parse_injection(text) for text in request.inject]
    check_injections(bench, injections, request.max_effect)
    injector = Injector(injections, wrap)
    wrap = injector.wrap if injections else wrap
    if is_endoscope(bench.description):
        from firmware_py.endoscope.app import run_request

        return run_request(request, bench, on_status, runtime_dir, on_open, wrap, own_process=own_process)
    # everything that can be wrong with the file, and the compiler's seconds, before a device is touched
    plan = load_plan(bench, request.method)
    Stages(plan.stages).warm_up()
    with contextlib.ExitStack() as stack:
        opened = stack.enter_context(open_requested(request, bench, runtime_dir, wrap))
        if on_open is not None:
            on_open(opened)
        devices = open_devices(opened, plan.options)
        plan = plan.with_wiring(devices.sensing_table)
        config, configs = plan.firmware, plan.stages
        if request.stale_ms is not None:
            stalled_ms = max(request.stale_ms, config.safety.stalled_ms)
            safety = config.safety.model_copy(update={"stale_ms": request.stale_ms, "stalled_ms": stalled_ms})
            config = config.model_copy(update={"safety": safety})
        heart = stack.enter_context(guarded(opened, devices, config.safety, opened.runtime_dir, may_end_us=own_process))
        stages = Stages(configs)
        recorder = _recorder(request, bench, configs, opened)
        live = None
        if request.live_fds is not None:
            live = LiveLink(*request.live_fds)
            stack.callback(live.close)
            (opened.runtime_dir / "metadata.json").write_text(json.dumps(recording_metadata(bench, configs, opened)))
        make_loop: Callable[..., InstrumentLoop] = InstrumentLoop
        if request.compiled:
            from firmware_py.compiled.loop import CompiledLoop

            make_loop = partial(CompiledLoop, spin_us=request.spin_us)
        loop = make_loop(
            devices,
            stages,
            config,
            opened.clock,
            tick_hz=plan.tick_hz,
            recorder=recorder,
            on_status=with_fallbacks(on_status, stages),
            live=live,
            sense_only=request.sense_only,
            others_stalled_ms=opened.world.stalled_ms if opened.world is not None else None,
        )
        if on_status is not None and live is not None:
            on_status(
                {"event": "devices", "identities": devices.identities, "histograms": list(loop.shown.histograms())}
            )
        report, machine, cpu_share = RealtimeReport(), describe_machine(opened), None
        summary: RecordingSummary | None = None
        interrupts = stack.enter_context(count_interrupts()) if own_process else lambda: 0
        try:
            with scheduling(request, opened) as report:
                wall_s, cpu_s = time.monotonic(), time.process_time()
                loop.run(request.seconds)
                cpu_share = (time.process_time() - cpu_s) / max(time.monotonic() - wall_s, 1e-9)
        finally:
            if recorder is not None:
                summary = recorder.stop(loop.scheduler.snapshot().as_dict())
        if heart is not None and heart.noticed_ns:
            loop.counts.noticed.setdefault("no command for a while (guardian)", heart.noticed_ns)
        # before the emulated world ends: the guardian may still have something to do
        last_word, so_far = {}, interrupts()
        if devices.guardian is not None:
            last_word = devices.guardian.finish(hurry=lambda: interrupts() > so_far)
        outcome = make_outcome(request, opened, devices, loop, report, summary, last_word)
        outcome["host"] = describe_host(opened, loop.scans.host_gaps, cpu_share)
        outcome["machine"] = machine
        if injections:
            outcome["injected"] = injector.counts()
        return outcome, truth_of(opened)


def with_fallbacks(sink: StatusSink | None, stages: Stages) -> StatusSink | None:
    """``sink``, which is also told in how many ticks the chosen kinematics gave way to the other one."""
    if sink is None:
        return sink
    return lambda status: sink({**status, "fallbacks": stages.sensing.fallbacks} if "t_s" in status else status)


def _recorder(
    request: RunRequest, bench: BenchFile, configs: StageConfigs, opened: OpenBench
) -> RecorderProcess | None:
    if request.record is None:
        return None
    columns = list(zip(LAYOUT.scalar_names(), LAYOUT.scalar_units(), strict=True))
    return RecorderProcess.start(request.record, columns, recording_metadata(bench, configs, opened))


def recording_metadata(bench: BenchFile, configs: StageConfigs, opened: OpenBench) -> dict[str, str]:
    """Return the metadata that a recording keeps about its run."""
    return {
        "bench": bench.text,
        "bench_name": bench.description.name,
        "stages": json.dumps(configs.as_dict()),
        "git_revision": git_revision(),
        "clock": "virtual" if opened.virtual else "real",
        "tick_hz": str(bench.description.clock.tick_hz),
    }


def make_outcome(
    request: RunRequest,
    opened: OpenBench,
    devices: Devices,
    loop: InstrumentLoop,
    report: RealtimeReport,
    recording: RecordingSummary | None,
    guardian: Mapping[str, Any],
) -> dict[str, Any]:
    """Return the part of the run's JSON that the firmware itself knows. ``guardian``: the guardian's last report."""
    snapshot = loop.scheduler.snapshot()
    supervisor, counts = loop.supervisor, loop.counts
    trip = supervisor.trip_cause
    reason = trip.reason if trip is not None else "never left the boot state"
    reached, reached_ns = supervisor.safe_reached, loop.safe_reached_ns
    if not reached and (guardian.get("neutral_ns") or 0) > (reached_ns or 0):
        reached, reached_ns = True, guardian["neutral_ns"]
        reason += f"; the firmware did not reach the outputs ({supervisor.ramp_failure}), but the guardian did"
    elif supervisor.ramp_failure:
        reason += f"; neutral NOT confirmed ({supervisor.ramp_failure}): switch the amplifier off"
    late_ms = None
    on_time = supervisor.safe_reached and not supervisor.was_late
    took_ms = (reached_ns - trip.t_ns) * 1e-6 if trip is not None and reached_ns and reached else 0.0
    if took_ms > 0.0 and not (on_time and took_ms <= 1e3 * (RAMP_TICKS + 1) / opened.file.description.clock.tick_hz):
        late_ms = took_ms
        reason += f"; neutral was confirmed only after {late_ms:.0f} ms"
    return {
        "format": 1,
        "bench": opened.file.description.name,
        "clock": "virtual" if opened.virtual else "real",
        "seconds": request.seconds,
        "devices": devices.identities,
        "armed_ns": loop.armed_ns,
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
        "latency": {"sample_to_command_us": counts.latency.distribution().as_dict()},
        "samples": {
            "expected": counts.expected,
            "received": counts.received,
            "lost": counts.lost,
            "unread": counts.unread,
        },
        "noticed": dict(counts.noticed),
        "commands": {
            "sent": counts.commands,
            "superseded": counts.superseded,
            "clipped": counts.clipped,
            # ticks by limit, as the actuation stage sees them
            "limited": loop.stages.actuation.limited,
        },
        "magnetometer_errors": counts.magnetometer_errors,
        "holds": loop.list_holds(),
        "guardian": devices.guardian.describe() if devices.guardian is not None else None,
        "warnings": dict(supervisor.warnings),
        "safe_state": {
            "reached": reached,
            "late_ms": late_ms,
            "reason": reason,
            "finding": trip.finding.name.lower() if trip is not None else None,
            "class": trip.cause.value if trip is not None else None,
            "normal": trip is not None and trip.normal and reached and on_time,
            "tick": trip.tick if trip is not None else -1,
            "asked_ns": loop.asked_safe_ns,
            "reached_ns": reached_ns,
        },
        "estimator": loop.stages.configs.tremor.method,
        "kinematics": {
            "method": loop.stages.configs.sensing.kinematics_method,
            "fallbacks": loop.stages.sensing.fallbacks,
        },
        "loop": loop.describe(),
        "realtime": describe_scheduling(report, opened.virtual),
        "recording": str(recording.path) if recording is not None else None,
        "recorder": {
            "ticks": recording.ticks if recording is not None else 0,
            "dropped": recording.dropped if recording is not None else 0,
            "problem": recording.problem if recording is not None else "",
        },
    }


# -- own process ------------------------------------------------------------------------------------------


def _die_with_parent() -> None:
    """Make the kernel send SIGTERM to this process when its parent dies: the loop then ramps to neutral."""
    with contextlib.suppress(AttributeError, OSError):
        ctypes.CDLL(None).prctl(1, signal.SIGTERM, 0, 0, 0)


def _status_pipe() -> StatusSink:
    """Status lines to standard output; a reader that does not read costs lines, never time."""
    descriptor = sys.stdout.fileno()
    os.set_blocking(descriptor, False)

    def send(status: Mapping[str, Any]) -> None:
        with contextlib.suppress(BlockingIOError, BrokenPipeError):
            os.write(descriptor, (json.dumps(status) + "\n").encode())

    return send


def main(arguments: list[str]) -> int:
    """Run ``python -m firmware_py.app REQUEST.json``, which writes ``outcome.json`` beside the request."""
    _die_with_parent()
    table = json.loads(Path(arguments[0]).read_text())
    runtime_dir = Path(table.pop("runtime_dir"))
    record = table.pop("record")
    live_fds = table.pop("live_fds")
    request = RunRequest(
        **{**table, "bench": Path(table["bench"]), "record": Path(record) if record is not None else None},
        live_fds=tuple(live_fds) if live_fds is not None else None,
    )
    try:
        outcome, truth = run_in_process(request, _status_pipe(), runtime_dir, own_process=True)
    except HalError as error:
        sys.stderr.write(f"micron: {error}\n")
        return int(exit_code_of(error))
    if truth is not None:
        np.savez(runtime_dir / "truth.npz", **truth)
    (runtime_dir / "outcome.json").write_text(json.dumps(outcome))
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
