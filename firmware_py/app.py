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
from collections.abc import Callable, Mapping
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from firmware_py.control.app import MicronPlan
from firmware_py.control.instrument import Micron
from firmware_py.control.plan import load_plan
from firmware_py.control.program import check_program, load_program
from firmware_py.control.stages import Stages
from firmware_py.endoscope.wiring import is_endoscope
from firmware_py.exit_codes import exit_code_of
from firmware_py.inject import Injector, check_injections, parse_injection
from firmware_py.run.context import StatusSink
from firmware_py.run.instrument import InstrumentPlan
from firmware_py.run.session import run_plan
from firmware_py.run_request import RunRequest, open_requested, truth_of
from hal.bench import BenchFile, OpenBench, Port, load_bench
from hal.contracts import Clock
from hal.errors import HalError


def run_in_process(
    request: RunRequest,
    on_status: StatusSink | None = None,
    runtime_dir: Path | None = None,
    on_open: Callable[[OpenBench], None] | None = None,
    wrap: Callable[[str, Port, Clock], Port] | None = None,
    *,
    own_process: bool = False,
) -> tuple[dict[str, Any], dict[str, Any] | None]:
    """Run the instrument of the bench; returns the outcome (JSON values) and, from an emulated world, the truth.

    Raises ``HalError`` when the bench cannot be opened. What goes wrong later is in the outcome's
    ``safe_state``; a world that died leaves no truth. ``on_open`` may prepare the bench before its devices are
    opened, ``wrap`` put middleware around its ports (fault tests). ``own_process``: this process is the firmware and
    nothing else; the guardian may kill it where it stands still in the middle of a command.
    """
    bench = load_bench(request.bench)
    injections = [parse_injection(text) for text in request.inject]
    check_injections(bench, injections, request.max_effect)
    injector = Injector(injections, wrap) if injections else None
    # everything that can be wrong with the file, and the compiler's seconds, before a device is touched
    plan = load_instrument(bench, request)
    with open_requested(request, bench, runtime_dir, injector.wrap if injector is not None else wrap) as opened:
        if on_open is not None:
            on_open(opened)
        _, outcome = run_plan(request, plan, opened, on_status, injector, own_process=own_process)
        return outcome, truth_of(opened)


def load_instrument(bench: BenchFile, request: RunRequest) -> InstrumentPlan:
    """Return the plan of the instrument that ``bench`` describes, compiled or loaded. Raises ``BenchError``."""
    if is_endoscope(bench.description):
        from firmware_py.endoscope.app import load_endoscope

        return load_endoscope(bench)
    plan = load_plan(bench, request.method)
    program = None
    if request.manual is not None:
        program = load_program(request.manual)
        check_program(request.manual, program, plan.stages.actuation)
    Stages(plan.stages).warm_up()
    if request.compiled:
        from firmware_py.compiled.loop import CompiledMicron

        return MicronPlan(plan, partial(CompiledMicron, spin_us=request.spin_us))
    if program is not None:
        return MicronPlan(plan, partial(Micron, program=program))
    return MicronPlan(plan)


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
    table: dict[str, Any] = json.loads(Path(arguments[0]).read_text())
    runtime_dir = Path(table.pop("runtime_dir"))
    live_fds = table.pop("live_fds")
    for name in ("bench", "record", "manual"):
        table[name] = Path(table[name]) if table[name] is not None else None
    table["live_fds"] = tuple(live_fds) if live_fds is not None else None
    request = RunRequest(**table)
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
