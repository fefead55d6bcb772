"""Implements ``micron bench``: it serves the page of a running firmware."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer
from rich.text import Text

from firmware_py.compiled.eligible import check_compiled
from firmware_py.endoscope.wiring import is_endoscope
from hal.bench import check_pace, load_bench
from tools.cli.bench_option import (
    BenchOption,
    CompiledOption,
    HandOption,
    RealtimeOption,
    SeedOption,
    bench_path,
    check_hand,
)
from tools.cli.common import clear_errors, console
from tools.cli.run_watch import RateOption, ReferenceOption, WatchOption, check_twin, watch_settings
from tools.cli.trust import OutsideOption, TrustOption, decide_on
from tools.errors import InputError
from tools.output import check_names
from tools.prepare import prepare
from tools.reports.loop_lines import loop_lines


def bench(
    *,
    bench: BenchOption = None,
    port: Annotated[int, typer.Option(min=0, max=65535, help="Port of the page; 0 takes any free one.")] = 8750,
    listen: Annotated[
        str | None,
        typer.Option(
            metavar="ADDRESS", help="Listen on this address instead of loopback; every request then needs the token."
        ),
    ] = None,
    host_name: Annotated[
        list[str] | None,
        typer.Option(metavar="NAME", help="With --listen: host names under which the page is reached."),
    ] = None,
    recordings: Annotated[Path, typer.Option(metavar="FOLDER", help="Folder for recordings.")] = Path("out/recordings"),
    hand: HandOption = None,
    stale_ms: Annotated[
        float | None,
        typer.Option(
            min=1.0, max=1000.0, help="Time without scans, in ms, that ends the run; raise it on a busy machine."
        ),
    ] = None,
    seed: SeedOption = None,
    watch: WatchOption = None,
    watch_reference: ReferenceOption = None,
    false_alarms_per_hour: RateOption = None,
    trust: TrustOption = False,
    allow_outside: OutsideOption = False,
    realtime: RealtimeOption = False,
    compiled: CompiledOption = False,
) -> None:
    """Run the instrument and serve the bench page for it, until Ctrl-C.

    Example: micron bench --port 8750
    """
    from tools.bench.firmware import Choice
    from tools.bench.serve import LOOPBACK, bind, serve

    with clear_errors():
        check_names(recordings)
        if host_name and listen is None:
            raise InputError("--host-name belongs to --listen; give both or neither")
        file = bench_path(bench).absolute()
        if watch is not None:
            decide_on([watch], trust, allow_outside)
        description = load_bench(file)
        pace = check_pace(description, "realtime" if realtime else None)
        if compiled:
            check_compiled(description, pace)
        watching = watch_settings(description, watch, watch_reference, false_alarms_per_hour)
        if watching is not None:
            check_twin(watching, description)
        if not is_endoscope(description.description):
            check_hand(hand)
            prepare(description, None, console())
        elif hand is not None:
            raise InputError("--hand belongs to the instrument; an endoscope bench has none")
        try:
            recordings.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise InputError(
                f"--recordings {recordings}: cannot be made ({error.strerror}); name a folder that you may write to"
            ) from error
        sock = bind(listen or LOOPBACK, port)

        def announce(address: str) -> None:
            console().print(
                Text.assemble("bench page: ", (address, "bold"), "  (the token is shown only here; Ctrl-C ends)"),
                soft_wrap=True,
            )

        for line in loop_lines(description, pace, compiled=compiled):
            console().print(line)
        choice = Choice(file, hand, None, seed, stale_ms, pace="realtime" if realtime else None, compiled=compiled)
        serve(choice, recordings.absolute(), sock, announce, names=tuple(host_name or ()), watch=watching)
