"""Implements ``micron run``: it runs the instrument in closed loop and reports what is left of the tremor."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Callable, Mapping
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer
from rich.console import RenderableType
from rich.live import Live
from rich.spinner import Spinner
from rich.text import Text

from firmware_py.compiled.eligible import INJECTED, check_compiled, check_spin
from firmware_py.endoscope.wiring import is_endoscope
from firmware_py.guardian.process import END_S, REPORT, STARTED, describe
from firmware_py.inject import check_injections, late_starts, parse_injection
from firmware_py.machine.processors import format_processors
from firmware_py.run_request import RunRequest
from firmware_py.tremor.config import Method, all_methods, why_unknown
from hal.bench import SIM_SCHEME, BenchFile, check_pace, load_bench
from hal.children import child_command, child_environment
from tools.cli.bench_option import (
    BenchOption,
    CompiledOption,
    HandOption,
    RealtimeOption,
    ScaleOption,
    SeedOption,
    bench_path,
    check_hand,
)
from tools.cli.common import Exit, JsonOption, check_recording_name, clear_errors, console, place_picture, print_note
from tools.cli.run_watch import RateOption, ReferenceOption, RunWatch, WatchOption, check_twin, watch_settings
from tools.cli.trust import OutsideOption, TrustOption, decide_on
from tools.errors import InputError
from tools.output import check_names, check_writable, write_json
from tools.prepare import prepare
from tools.reports.loop_lines import loop_lines

if TYPE_CHECKING:
    from tools.mismatch.watch.live import Settings
    from tools.reports.run_live import TipWatch

PICTURE = Path("out/run.png")
"""Default file of the picture."""
FULL_EFFECT = 4
"""Effect (scale of ``--max-effect``) of what moves the outputs."""
SETTLE_S = 2.0
"""Time after arming within which the estimator locks and the soft start ends. Figures are taken after it."""


def run(
    *,
    bench: BenchOption = None,
    seconds: Annotated[float, typer.Option(min=0.5, max=86_400.0, help="Time of the run after arming, in s.")] = 10.0,
    virtual: Annotated[
        bool, typer.Option("--virtual", help="Emulated bench: run as fast as possible, not a second per second.")
    ] = False,
    realtime: RealtimeOption = False,
    compiled: CompiledOption = False,
    spin_us: Annotated[
        float, typer.Option(min=0.0, help="With --compiled: poll without sleeping for so many us around each scan.")
    ] = 0.0,
    cpu: Annotated[
        int | None, typer.Option(min=0, help="In real time: the processor that the loop stays on (isolcpus).")
    ] = None,
    hand: HandOption = None,
    scale: ScaleOption = None,
    sense_only: Annotated[
        bool, typer.Option("--sense-only", help="Arm nothing; use it to record poses turned by hand, or raw sensors.")
    ] = False,
    manual: Annotated[
        Path | None,
        typer.Option(
            metavar="PROGRAM.toml",
            help="Voltage program that the outputs play, to its end, in place of the compensation.",
        ),
    ] = None,
    record: Annotated[Path | None, typer.Option(metavar="FILE", help="Record the run (.mcap).")] = None,
    watch: WatchOption = None,
    watch_reference: ReferenceOption = None,
    false_alarms_per_hour: RateOption = None,
    method: Annotated[
        str | None, typer.Option(metavar="NAME", help="Another tremor estimator than the bench file's.")
    ] = None,
    seed: SeedOption = None,
    inject: Annotated[
        list[str] | None,
        typer.Option(
            metavar="BUS:KEY=VALUE", help="A fault on a bus, e.g. daq0:loss=0.001,from_s=2 (may be repeated)."
        ),
    ] = None,
    max_effect: Annotated[
        int | None,
        typer.Option(min=0, max=4, help="With --inject on a real bus: 1 may spoil readings, 4 may move the outputs."),
    ] = None,
    trust: TrustOption = False,
    allow_outside: OutsideOption = False,
    json_file: JsonOption = None,
    html: Annotated[Path | None, typer.Option(metavar="FILE", help="Write a self-contained HTML report.")] = None,
    image: Annotated[
        Path | None,
        typer.Option(
            "--picture",
            metavar="FILE",
            help=f"Picture (PNG) of the tip without and with compensation; default {PICTURE}.",
        ),
    ] = None,
) -> None:
    """Run the instrument in closed loop and report what was left of the tremor.

    An emulated bench runs in emulated time, one second per second, and gives the same result on every machine. Real
    devices always run in real time.

    Example: micron run --virtual --seconds 20 --json -
    """
    with clear_errors():
        check_names(image, record)
        check_recording_name(record)
        reads = [bench, hand, manual, watch]
        check_writable(json_file, html, record, image, reads=reads)
        image = place_picture(image, PICTURE, formats=(".png",), reads=reads)
        if scale is not None and hand is None:
            raise InputError("--scale belongs to --hand FILE; give both or neither")
        if max_effect is not None and not inject and manual is None:
            raise InputError("--max-effect belongs to --inject or --manual; give both or neither")
        if virtual and realtime:
            raise InputError("--virtual and --realtime exclude each other; give one of them")
        decide_on([bench_path(bench), *([watch] if watch is not None else [])], trust, allow_outside)
        file = load_bench(bench_path(bench))
        pace = check_pace(file, "virtual" if virtual else "realtime" if realtime else None)
        if compiled:
            check_compiled(file, pace, injected=bool(inject))
            if sense_only:
                raise InputError("--compiled runs while outputs move, and --sense-only moves none; give one of them")
        _check_processor(pace, cpu)
        if spin_us and not compiled:
            raise InputError("--spin-us belongs to --compiled; give both or neither")
        check_spin(file, spin_us)
        if manual is not None:
            seconds = max(seconds, _program_seconds(file, manual, max_effect, compiled, sense_only))
        watching = watch_settings(file, watch, watch_reference, false_alarms_per_hour, seconds)
        request = RunRequest(
            bench=bench_path(bench),
            compiled=compiled,
            spin_us=spin_us,
            cpu=cpu,
            seconds=seconds,
            pace=pace,
            hand_file=hand,
            hand_scale=scale,
            record=record,
            seed=seed,
            sense_only=sense_only,
            inject=tuple(inject or ()),
            max_effect=max_effect,
            manual=manual,
            method=None if method is None else estimator_name(method),
        )
        injections = [parse_injection(text) for text in request.inject]
        check_injections(file, injections, max_effect)
        if is_endoscope(file.description) and (hand is not None or html is not None or sense_only):
            raise InputError("--hand, --html and --sense-only belong to the instrument; an endoscope bench has none")
        if is_endoscope(file.description) and method is not None:
            raise InputError("--method belongs to the instrument; an endoscope bench estimates no tremor")
        check_hand(hand)
        if watching is not None:
            check_twin(watching, file)
        for late in late_starts(injections, seconds):
            print_note(late)
        if not is_endoscope(file.description):
            from tools.reports.run_live import opening_lines

            for line in opening_lines(file, seconds, pace, hand, seed):
                console().print(line)
        orders = _orders_in_python(inject=bool(inject), sense_only=sense_only, manual=manual is not None)
        for line in loop_lines(file, pace, compiled=compiled, orders=orders):
            console().print(line)
        if not is_endoscope(file.description):
            prepare(file, request.method, console())
        beside = None if watching is None else _open_watch(watching, file, request)
        outcome, truth = _run_real(request, beside) if pace == "realtime" else _run_emulated(request, beside)
        if outcome.get("instrument") == "endoscope":
            finish_endoscope_run(outcome, truth, json_file)
            return
        # only now: the firmware did not wait for what draws
        from tools.reports.run_report import next_steps, write_report

        result = complete_result(outcome, truth)
        steps = next_steps(result)
        if beside is not None:
            from tools.mismatch.watch.live import lines

            found = beside.close()
            result["watch"] = found.to_json()
            steps = [*lines(found), *steps]
        write_report(result, truth, console(), json_file=json_file, html=html, image=image, more=steps)
        raise typer.Exit(exit_status(result))


def _orders_in_python(*, inject: bool, sense_only: bool, manual: bool) -> list[str]:
    """Return why the options of a run keep its ticks in Python."""
    reasons = {
        INJECTED: inject,
        "--sense-only moves no outputs, and the compiled thread runs while they move": sense_only,
        "--manual plays voltages in the Python loop": manual,
    }
    return [why for why, is_asked in reasons.items() if is_asked]


def _check_processor(pace: str, cpu: int | None) -> None:
    if cpu is None:
        return
    if pace != "realtime":
        raise InputError("--cpu belongs to real time; add --realtime, or leave it out")
    available = sorted(os.sched_getaffinity(0))
    if cpu not in available:
        raise InputError(
            f"--cpu {cpu}: this process may use processors {format_processors(available)}; name one of them"
        )


def _program_seconds(file: BenchFile, manual: Path, max_effect: int | None, compiled: bool, sense_only: bool) -> float:
    """Return how long a program of voltages lasts; refuse it where it cannot be played."""
    from firmware_py.control.program import load_program

    if is_endoscope(file.description):
        raise InputError("--manual belongs to the instrument; an endoscope bench has no outputs that it could move")
    if compiled or sense_only:
        raise InputError("--manual plays voltages in the Python loop; leave --compiled and --sense-only out")
    if not is_emulated(file) and (max_effect is None or max_effect < FULL_EFFECT):
        raise InputError(f"--manual moves real outputs of {file.path}; allow it with --max-effect {FULL_EFFECT}")
    return load_program(manual).seconds


def is_emulated(file: BenchFile) -> bool:
    """Return whether every bus of a bench is emulated."""
    return all(bus.uri.startswith(SIM_SCHEME) for bus in file.description.bus.values())


def exit_status(result: Mapping[str, Any]) -> Exit:
    """Return the exit status that tells whose fault an end was (contracts/commands.md)."""
    safe = result["safe_state"]
    if safe.get("finding") == "stopped" and "SIGINT" in safe["reason"]:
        return Exit.INTERRUPTED
    if not safe["normal"]:
        return Exit.HOST_UNFIT if safe.get("class") == "host" and safe["reached"] else Exit.FAILED
    return Exit.DATA_LOST if result["samples"]["lost"] or result["recorder"]["dropped"] else Exit.DONE


def complete_result(outcome: dict[str, Any], truth: Mapping[str, Any] | None) -> dict[str, Any]:
    """Return the outcome of the firmware with the figures that need the truth."""
    empty = {"uncompensated_rms_um": None, "compensated_rms_um": None, "reduction_percent": None}
    figures: dict[str, Any] = {
        "tremor": {
            "band_hz": [8, 12],
            **empty,
            "per_axis": {a: dict(empty) for a in "xyz"},
            "whole_band_error": empty,
            "bands": [],
            "spectrum": {"hz": [], "without_um_rtHz": [], "with_um_rtHz": []},
        },
        "voluntary": {"gain": None, "delay_ms": None},
    }
    if truth is not None and outcome["armed_ns"] is not None:
        from tools.reports.figures import tremor_figures

        scored = tremor_figures(truth, from_ns=outcome["armed_ns"] + round(SETTLE_S * 1e9), to_ns=outcome["safe_ns"])
        if scored is not None:
            figures = scored.to_json()
    return {**outcome, **figures}


def _open_watch(settings: Settings, file: BenchFile, request: RunRequest) -> RunWatch:
    """Start the watch of a run. In emulated time the run waits for it, in real time it never does."""
    from tools.mismatch.watch.frame import World

    world = World(request.seed, request.hand_file, request.hand_scale)
    return RunWatch(settings, file, world, is_patient=request.pace != "realtime")


def _run_emulated(request: RunRequest, beside: RunWatch | None) -> tuple[dict[str, Any], dict[str, Any] | None]:
    """Run an emulated bench in this process: in emulated time nothing waits for the loop."""
    from firmware_py.app import run_in_process
    from tools.reports.run_live import TipWatch

    watch, key = TipWatch(), RearmKey(lambda: signal.raise_signal(signal.SIGUSR1))
    if beside is not None:
        request = replace(request, live_fds=beside.fds)
    opening = Spinner("dots", "opening the emulated bench")
    with Live(opening, console=console(), refresh_per_second=8, transient=True) as live:

        def show(status: dict[str, Any]) -> None:
            if beside is not None:
                beside.look(status)
            if "event" in status:
                return
            key.look(status)
            live.update(_status_line(status, request.seconds, watch))

        return run_in_process(request, show, on_open=watch.attach)


class RearmKey:
    """Enter on a terminal ends a hold that waits for the operator. ``rearm`` is called while such a hold lasts only."""

    def __init__(self, rearm: Callable[[], object]) -> None:
        self._rearm = rearm
        self._is_asked_for = False
        if sys.stdin is not None and sys.stdin.isatty():
            threading.Thread(target=self._read, daemon=True).start()

    def look(self, status: Mapping[str, Any]) -> None:
        """Know from the firmware's status whether a hold waits for the operator."""
        hold = status.get("hold")
        self._is_asked_for = bool(hold) and hold["rearm"] == "operator"

    def press(self) -> None:
        """Enter was pressed."""
        if self._is_asked_for:
            self._rearm()

    def _read(self) -> None:
        for _ in sys.stdin:
            self.press()


def _run_real(request: RunRequest, beside: RunWatch | None) -> tuple[dict[str, Any], dict[str, Any] | None]:
    """Run the firmware in a process of its own: this one draws, and a busy thread beside the loop would cost ticks."""
    with tempfile.TemporaryDirectory(prefix="micron-") as folder:
        runtime_dir = Path(folder)
        fds = () if beside is None else beside.fds
        if beside is not None:
            request = replace(request, live_fds=beside.fds)
        request_file = runtime_dir / "request.json"
        request_file.write_text(request.to_json(runtime_dir))
        process = subprocess.Popen(
            child_command("firmware_py.app", str(request_file)),
            stdout=subprocess.PIPE,
            text=True,
            pass_fds=fds,
            env=child_environment(),
        )
        for fd in fds:
            os.close(fd)
        try:
            _watch(process, request.seconds, beside)
        except KeyboardInterrupt:
            # the firmware ramps to neutral and reports; a second interrupt is the operator's own choice
            process.send_signal(signal.SIGINT)
        process.wait()
        if process.returncode < 0:
            _tell_of_the_guardian(runtime_dir, -process.returncode)
        outcome_file = runtime_dir / "outcome.json"
        if process.returncode not in (0, None) or not outcome_file.exists():
            raise typer.Exit(process.returncode if process.returncode and process.returncode > 0 else Exit.FAILED)
        outcome = json.loads(outcome_file.read_text())
        truth_file = runtime_dir / "truth.npz"
        truth = None
        if truth_file.exists():
            import numpy as np

            with np.load(truth_file, allow_pickle=False) as archive:
                truth = {name: archive[name] for name in archive.files}
        return outcome, truth


def _tell_of_the_guardian(runtime_dir: Path, number: int) -> None:
    """Print what became of the outputs after the firmware was killed."""
    report, started = runtime_dir / REPORT, runtime_dir / STARTED
    limit_s = time.monotonic() + (float(started.read_text()) + END_S if started.exists() else 0.0)
    while not report.exists() and time.monotonic() < limit_s:
        time.sleep(0.01)
    guardian_words = (
        describe(json.loads(report.read_text())) if report.exists() else "no word from a guardian of the outputs"
    )
    console().print(f"the firmware was killed by signal {number}; {guardian_words}")


def _watch(process: subprocess.Popen[str], seconds: float, beside: RunWatch | None) -> None:
    """Draw the status lines of the firmware until it ends."""
    assert process.stdout is not None
    from tools.reports.run_live import TipWatch

    watch, key = TipWatch(), RearmKey(lambda: process.send_signal(signal.SIGUSR1))
    starting = Spinner("dots", "starting the emulated world and the firmware")
    with Live(starting, console=console(), refresh_per_second=8, transient=True) as live:
        for line in process.stdout:
            status = json.loads(line)
            if beside is not None:
                beside.look(status)
            if "event" in status:
                continue
            key.look(status)
            live.update(_status_line(status, seconds, watch))


def finish_endoscope_run(outcome: dict[str, Any], truth: Mapping[str, Any] | None, json_file: str | None) -> None:
    """Report, JSON and exit code of an endoscope bench."""
    from tools.reports.endoscope_report import complete_run, print_run

    result = complete_run(outcome, truth)
    print_run(result, console())
    write_json(result, json_file)
    raise typer.Exit(exit_status(result))


def _status_line(status: dict[str, Any], seconds: float, watch: TipWatch) -> RenderableType:
    if "view" in status:
        from tools.reports.endoscope_report import status_table

        return status_table(status, seconds)
    from tools.reports.run_live import live_line

    return Text(live_line(status, seconds, watch), no_wrap=True)


def estimator_name(name: str) -> Method:
    """Return ``name``. Raises ``InputError`` for a name that is no estimator of the instrument."""
    if name in all_methods():
        return name
    if name in ("nn", "cascade"):
        raise InputError(
            f"'{name}': the cascade network takes the tip's displacement, steady part and all, and this instrument "
            "senses acceleration, which has none"
        )
    raise InputError(why_unknown(name))
