"""Implements the diagnostic commands, thin over ``tools.diagnose``."""

from __future__ import annotations

import sys
from enum import StrEnum
from pathlib import Path
from typing import Annotated

import typer
from rich.live import Live
from rich.text import Text

from firmware_py.compiled.eligible import check_compiled
from hal.bench import load_bench
from tools.cli.bench_option import BenchOption, VirtualOption, bench_path, pace_of
from tools.cli.common import Exit, JsonOption, clear_errors, console, data_console, print_error, print_note
from tools.errors import InputError
from tools.interrupt import keep_what_is_there, need_some
from tools.output import check_writable, write_json
from tools.reports.loop_lines import loop_lines
from tools.terminal import table_of

YesOption = Annotated[bool, typer.Option("-y", "--yes", help="Do not ask before devices are touched.")]


TURN_S = 60.0
"""Length of one turn of a loop, with --hours."""


class ProbeChoice(StrEnum):
    """Names the ways to ask an I2C address."""

    READ = "read"
    WRITE = "write"


class PolicyChoice(StrEnum):
    """Names the scheduling policies that are measured."""

    OTHER = "other"
    FIFO = "fifo"
    BOTH = "both"


def _ask(question: str, yes: bool) -> None:
    try:
        agreed = yes or typer.confirm(question, err=True)
    except typer.Abort:  # nobody is there who could answer
        typer.echo(err=True)
        agreed = False
    if not agreed:
        raise InputError("you did not agree, so nothing was done; --yes agrees beforehand")


def scan(
    bench: BenchOption = None,
    probe: Annotated[
        ProbeChoice, typer.Option(help="Transaction that asks an I2C address: read a byte, or write none.")
    ] = ProbeChoice.READ,
    seconds: Annotated[float, typer.Option(min=0.0, max=3600.0, help="Time of listening to CAN, in s.")] = 1.0,
    yes: YesOption = False,
    virtual: VirtualOption = False,
    json_file: JsonOption = None,
) -> None:
    """List the machine's ports, the I2C addresses that answer and the CAN traffic; exit 4 when a declared I2C device
    is silent.

    Example: micron scan --bench micron
    """
    from tools.diagnose.opened import opened_bench
    from tools.diagnose.scan import PROBES, scan_bench

    with clear_errors():
        check_writable(json_file)
        path = bench_path(bench)
        kinds = {bus.kind for bus in load_bench(path).description.bus.values()}
        if "i2c" in kinds:
            console().print(f"I2C probe '{probe}': {PROBES[probe]}")
        if probe is ProbeChoice.WRITE:
            _ask("Write to every address of every I2C bus of this bench?", yes)
        with opened_bench(path, pace=pace_of(virtual)) as opened:
            result = scan_bench(opened, probe.value, seconds, lambda text: console().print(text, style="dim"))
        out = data_console()
        out.print("ports of this machine: " + (", ".join(result.ports) or "none"))
        if "i2c" in kinds:
            table = table_of("I2C", "bus", "address", "declared", "answers", left=4)
            for a in result.i2c:
                answered = Text("yes") if a.answered else Text("no", "bold red")
                table.add_row(a.bus, f"0x{a.address:02X}", a.declared or "-", answered)
            out.print(table)
        if "can" in kinds:
            traffic = table_of(f"CAN, {seconds:g} s", "bus", "id", "message", "frames", "rate (Hz)", left=5)
            for c in result.can:
                traffic.add_row(c.bus, f"0x{c.can_id:03X}", c.name, str(c.frames), f"{c.rate_hz:.1f}")
            out.print(traffic)
        write_json({"format": 1, **result.as_dict()}, json_file)
        if result.missing:
            console().print(f"no answer from {', '.join(result.missing)}: check power, wiring and address")
            raise typer.Exit(Exit.DEVICE_MISSING)


def scope(
    bench: BenchOption = None,
    seconds: Annotated[float, typer.Option(min=0.05, max=3600.0, help="Time of the measurement, in s.")] = 5.0,
    width: Annotated[int, typer.Option(min=8, max=400, help="Characters per line.")] = 72,
    virtual: VirtualOption = False,
    json_file: JsonOption = None,
) -> None:
    """Draw the analog inputs as lines in the terminal; outputs are not armed. Exit 3 when scans were lost.

    Example: micron scope --seconds 10
    """
    from tools.diagnose.opened import opened_bench
    from tools.diagnose.scope import Look, look, sparkline

    def text(seen: Look) -> str:
        rows = [f"{'input':<9}{'':<{width}} {'low (V)':>9} {'mean (V)':>9} {'high (V)':>9} {'rms (mV)':>9}"]
        for line, volts in zip(seen.lines() if seen.volts.size else [], seen.volts, strict=False):
            numbers = "".join(f" {v:9.4f}" for v in (line.low_V, line.mean_V, line.high_V))
            rows.append(f"{line.name:<9}{sparkline(volts, width):<{width}}{numbers} {1e3 * line.rms_V:9.2f}")
        rows.append(f"{seen.volts.shape[1] / seen.rate_hz:.1f} s at {seen.rate_hz:g} Hz, {seen.lost} scans lost")
        return "\n".join(rows)

    with clear_errors():
        check_writable(json_file)
        with (
            opened_bench(bench_path(bench), pace=pace_of(virtual)) as opened,
            Live(console=console(), refresh_per_second=8, transient=True) as live,
        ):
            kept: list[Look] = []

            def show(so_far: Look) -> None:
                kept[:] = [so_far]
                live.update(Text(text(so_far), no_wrap=True))

            with keep_what_is_there():
                show(look(opened, seconds, show))
        need_some(kept)
        seen = kept[0]
        if json_file != "-":
            typer.echo(text(seen))
        lines = {x.name: {k: getattr(x, k) for k in ("low_V", "mean_V", "high_V", "rms_V")} for x in seen.lines()}
        write_json({"format": 1, "rate_hz": seen.rate_hz, "lost": seen.lost, "inputs": lines}, json_file)
        if seen.lost:
            raise typer.Exit(Exit.DATA_LOST)


def latency(
    *,
    bench: BenchOption = None,
    seconds: Annotated[float, typer.Option(min=0.1, max=3600.0, help="Length of each measurement.")] = 5.0,
    hours: Annotated[
        float | None,
        typer.Option(min=0.001, max=168.0, help="Let all loops take turns for so many hours, instead of --seconds."),
    ] = None,
    policy: Annotated[
        PolicyChoice | None, typer.Option(help="Scheduling policy to measure; default both, fifo with --hours.")
    ] = None,
    firmware: Annotated[bool, typer.Option(help="Measure the firmware too, on the bench.")] = True,
    compiled: Annotated[
        bool, typer.Option("--compiled", help="Run the firmware's ticks in its compiled thread, not in Python.")
    ] = False,
    json_file: JsonOption = None,
) -> None:
    """Measure how late a 1 kHz loop is on this machine: in C, compiled, in Python, with a pty, as the firmware.

    With --hours the loops take turns of a minute, so that all have the same neighbours. The figures are those of
    cyclictest. Without a C compiler the loop in C is left out.

    Example: micron latency --hours 1
    """
    from firmware_py.machine.settings import read_machine
    from firmware_py.machine.tree import MACHINE
    from tools.diagnose.c_reference import CReference, compile_reference
    from tools.diagnose.latency import Lateness, Policy, loops_of, take_turns
    from tools.diagnose.latency_tables import figures_table, histogram_table

    with clear_errors():
        check_writable(json_file)
        path = bench_path(bench)
        file = load_bench(path)
        if compiled and not firmware:
            raise InputError("--compiled is how the firmware is measured, and --no-firmware leaves it out; give one")
        if compiled:
            check_compiled(file, "realtime")
        if firmware:
            for line in loop_lines(file, "realtime", compiled=compiled, label="firmware:"):
                console().print(line)
        chosen = policy or (PolicyChoice.BOTH if hours is None else PolicyChoice.FIFO)
        every: tuple[Policy, ...] = ("other", "fifo")
        policies: list[Policy] = [p for p in every if chosen is PolicyChoice.BOTH or p == chosen.value]
        reference = compile_reference()
        if isinstance(reference, str):
            print_note(f"no loop in C to compare with: {reference}")
        loops = [
            loop
            for p in policies
            for loop in loops_of(
                p,
                reference if isinstance(reference, CReference) else None,
                path if firmware else None,
                compiled=compiled,
            )
        ]
        turn_s = seconds if hours is None else min(TURN_S, 3600.0 * hours / len(loops))
        rounds = 1 if hours is None else max(1, round(3600.0 * hours / (turn_s * len(loops))))
        measurements: list[Lateness] = []
        with keep_what_is_there(), console().status("") as status:
            for what in take_turns(loops, rounds, turn_s, measurements):
                status.update(what)
        need_some(measurements)
        machine = read_machine(MACHINE)
        out = data_console()
        for p in policies:
            rows = [one for one in measurements if one.policy == p]
            if rows:
                out.print(figures_table(rows))
                out.print(histogram_table(rows))
                out.print(f"scheduling granted: {rows[0].scheduling}\n")
        if slow := [state.setting.name for state in machine if not state.is_good]:
            out.print(f"machine: not as wanted: {', '.join(slow)}; see micron doctor")
        compiler = {"compiler": reference.compiler} if isinstance(reference, CReference) else {"missing": reference}
        result = {"format": 1, "seconds": turn_s, "rounds": rounds, "rows": [one.as_dict() for one in measurements]}
        write_json({**result, "reference": compiler, "machine": [state.as_dict() for state in machine]}, json_file)


def ramp(
    *,
    bench: BenchOption = None,
    arm: Annotated[bool, typer.Option("--arm", help="Allow motion; without it nothing is moved.")] = False,
    channel: Annotated[list[int] | None, typer.Option(min=1, help="Output, from 1; default all.")] = None,
    steps: Annotated[int, typer.Option(min=2, max=1000, help="Number of steps between the limits.")] = 11,
    dwell_s: Annotated[float, typer.Option(min=0.001, max=60.0, help="Time on each step, in s.")] = 0.05,
    tolerance_V: Annotated[float, typer.Option("--tolerance", min=0.0, help="Largest allowed error, in V.")] = 0.05,
    yes: YesOption = False,
    virtual: VirtualOption = False,
    json_file: JsonOption = None,
) -> None:
    """Step the outputs over their full range and read each step back. Exit 1 when one is off.

    Example: micron ramp --arm --channel 1 --steps 21
    """
    from tools.diagnose.opened import opened_bench
    from tools.diagnose.ramp import RampStep
    from tools.diagnose.ramp import ramp as climb

    with clear_errors():
        check_writable(json_file)
        if not arm:
            raise InputError("this moves the actuators over their full range; say so with --arm")
        path = bench_path(bench)
        emulated = set(load_bench(path).description.emulated_buses())
        if len(emulated) < len(load_bench(path).description.bus):
            _ask("Move the actuators of this bench over their full range?", yes)
        channels = [c - 1 for c in channel or [1, 2, 3]]
        if max(channels) > 2:
            raise InputError(f"--channel {max(channels) + 1}: this instrument has outputs 1 to 3")
        table = table_of("Staircase", "output", "wanted (V)", "read back (V)", "error (mV)", left=0)

        def show(step: RampStep) -> None:
            bad = abs(step.error_V) > tolerance_V
            error = f"{1e3 * step.error_V:.2f}"
            table.add_row(
                str(step.channel + 1),
                f"{step.wanted_V:.2f}",
                f"{step.read_V:.3f}",
                Text(error, "red") if bad else error,
            )

        with opened_bench(path, pace=pace_of(virtual)) as opened:
            steps_done: list[RampStep] = []

            def keep(step: RampStep) -> None:
                steps_done.append(step)
                show(step)

            with keep_what_is_there():
                climb(opened, channels, steps, dwell_s, keep)
        need_some(steps_done)
        data_console().print(table)
        worst = max(steps_done, key=lambda s: abs(s.error_V))
        write_json(
            {
                "format": 1,
                "tolerance_V": tolerance_V,
                "worst_error_V": worst.error_V,
                "rows": [
                    {"output": s.channel + 1, "wanted_V": s.wanted_V, "read_V": s.read_V, "error_V": s.error_V}
                    for s in steps_done
                ],
            },
            json_file,
        )
        if abs(worst.error_V) > tolerance_V:
            console().print(f"output {worst.channel + 1} is {1e3 * worst.error_V:.1f} mV off at {worst.wanted_V:.2f} V")
            raise typer.Exit(Exit.FAILED)


def dump(
    bench: BenchOption = None,
    seconds: Annotated[float, typer.Option(min=0.01, max=86_400.0, help="Time of listening, in s.")] = 10.0,
    count: Annotated[int | None, typer.Option(min=1, help="Stop after so many frames.")] = None,
    virtual: VirtualOption = False,
    json_file: JsonOption = None,
) -> None:
    """Print CAN frames as they come, decoded where the id is known; nothing is sent.

    Example: micron dump --seconds 5
    """
    from tools.diagnose.can_frames import listen
    from tools.diagnose.opened import opened_bench

    with clear_errors():
        check_writable(json_file)
        path = bench_path(bench)
        buses = [name for name, spec in load_bench(path).description.bus.items() if spec.kind == "can"]
        if not buses:
            raise InputError(f"{path}: this bench has no CAN bus; name one that has with --bench")
        heard = []
        with opened_bench(path, pace=pace_of(virtual)) as opened, keep_what_is_there():
            for one in listen(opened, buses, seconds, count):
                heard.append(one.as_dict())
                if json_file != "-":
                    signals = "  ".join(f"{k}={v:g}" for k, v in one.signals.items())
                    frame = f"{one.frame.can_id:03X} [{len(one.frame.data)}] {one.frame.data.hex(' ')}"
                    typer.echo(f"{one.t_s:10.4f} {one.bus} {frame:<32} {one.message or '?'} {signals}")
        console().print(f"{len(heard)} frames")
        write_json({"format": 1, "frames": heard}, json_file)


def capture(
    out: Annotated[
        Path | None, typer.Option("--out", metavar="FOLDER", help="Record a transcript into this new folder.")
    ] = None,
    diff: Annotated[
        Path | None, typer.Option("--diff", metavar="FOLDER", help="Replay the transcript in this folder instead.")
    ] = None,
    bench: BenchOption = None,
    seconds: Annotated[float, typer.Option(min=0.01, max=600.0, help="With --out: time of the scan, in s.")] = 1.0,
    virtual: VirtualOption = False,
    json_file: JsonOption = None,
) -> None:
    """Record what goes over every bus while the drivers open the bench and scan, or replay such a transcript.

    Nothing is armed. With --diff the transcript is replayed against today's drivers and against the emulated devices:
    measured values differ between any two runs ("data"); questions and the form of answers must not ("protocol",
    exit 1). The emulated bench is then that of the transcript unless --bench names another.

    Example: micron capture --bench micron --out golden

    Compare: micron capture --diff golden
    """
    with clear_errors():
        check_writable(json_file)
        if (out is None) == (diff is None):
            raise InputError("name one folder: --out FOLDER records a transcript, --diff FOLDER replays one")
        if out is not None:
            _record_transcript(out, bench, seconds, virtual, json_file)
        elif diff is not None:
            _replay_transcript(diff, bench, json_file)


def _record_transcript(out: Path, bench: Path | None, seconds: float, virtual: bool, json_file: str | None) -> None:
    from tools.diagnose.golden import capture as record

    check_writable(out, folders=True)
    if out.exists():
        raise InputError(f"{out}: is there already; a golden transcript is not overwritten")
    counts = record(bench_path(bench), out, seconds, pace=pace_of(virtual))
    for bus, lines in counts.items():
        console().print(f"{bus}: {lines} transfers")
    write_json({"format": 1, "out": str(out), "transfers": counts}, json_file)


def _replay_transcript(folder: Path, bench: Path | None, json_file: str | None) -> None:
    from tools.diagnose.golden import diff

    report = diff(folder, None if bench is None else bench_path(bench))
    headings = ("bus", "against", "entry", "kind", "recorded", "now")
    table = table_of(f"{report.compared} transfers", *headings, left=6)
    for d in report.differences:
        table.add_row(d.bus, d.side, str(d.entry), d.kind, d.recorded, d.found)
    if report.differences:
        data_console().print(table)
    console().print(f"{report.protocol} differences of protocol, {report.data} of data")
    write_json({"format": 1, **report.as_dict()}, json_file)
    if not report.same:
        raise typer.Exit(Exit.FAILED)


def log(
    url: Annotated[str, typer.Option(help="Address of the page, with its token if it is not on loopback.")] = (
        "http://127.0.0.1:8750"
    ),
    seconds: Annotated[float | None, typer.Option(min=0.1, help="Time in s; default: until Ctrl-C.")] = None,
    json_file: JsonOption = None,
) -> None:
    """Print what a running 'micron bench' says, as it says it. Exit 4 when there is none.

    Example: micron log --url http://127.0.0.1:8750
    """
    from tools.diagnose.log_follow import follow

    with clear_errors():
        check_writable(json_file)
        lines = []
        try:
            with keep_what_is_there():
                for line in follow(url, seconds):
                    lines.append(line)
                    if json_file != "-":
                        typer.echo(f"{line['when']} {line['level']:<5} {line['text']}")
                        sys.stdout.flush()
        except ConnectionError as error:
            print_error(str(error))
            raise typer.Exit(Exit.DEVICE_MISSING) from error
        write_json({"format": 1, "lines": lines}, json_file)
