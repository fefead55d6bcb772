"""Implements ``micron replay``: it runs the same firmware over a recording, as fast as the machine can."""

from __future__ import annotations

import time
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer
from rich.text import Text

from tools.cli.common import Exit, JsonOption, clear_errors, console
from tools.output import check_writable, write_json

if TYPE_CHECKING:
    from firmware_py.recording.reader import Recording


def _reason(opened: Recording) -> str:
    """Say what probably made the ticks of ``opened`` differ."""
    tick = int(opened.column("tick")[0]) if "tick" in opened.names else 0
    if tick > 0:
        return f"The recording starts at tick {tick} of its run, and what the filters held then is not in it."
    return "Was the recording made by another revision of the firmware?"


def replay(
    recording: Annotated[Path, typer.Argument(metavar="RECORDING", help="A recording made by micron run --record.")],
    json_file: JsonOption = None,
) -> None:
    """Run the firmware over a recording and compare every estimate and command with the recorded one, bit for bit.

    Example: micron replay out/run.mcap
    """
    from firmware_py.recording.reader import Recording
    from firmware_py.replay import replay_recording

    with clear_errors():
        check_writable(json_file, reads=[recording])
        opened = Recording(recording)
        started_s = time.perf_counter()
        report = replay_recording(opened)
        took_s = time.perf_counter() - started_s
        tick_hz = opened.tick_hz
        recorded_s = report.rows / tick_hz
        say = console()
        for line in opened.health.lines():
            say.print(line)
        if report.identical:
            say.print(f"{report.rows} ticks replayed: every estimate and command is the recorded one, bit for bit")
        else:
            say.print(
                Text.assemble(
                    (f"{report.mismatching_rows} of {report.rows} ticks differ", "bold red"),
                    f"; the first: {report.first}. {_reason(opened)}",
                )
            )
        say.print(f"{recorded_s:.1f} s in {took_s:.2f} s: {recorded_s / took_s:.0f} x real time")
        write_json(
            {
                "format": 1,
                "recording": str(recording),
                **report.as_dict(),
                "seconds": took_s,
                "times_real_time": recorded_s / took_s,
                "health": opened.health.as_dict(),
            },
            json_file,
        )
        if not report.identical:
            raise typer.Exit(Exit.FAILED)
        if opened.health.lost:
            raise typer.Exit(Exit.DATA_LOST)
