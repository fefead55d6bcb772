"""Defines the options of an emulated bench, the same in every command."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from hal.clock import Pace

BenchOption = Annotated[
    Path | None,
    typer.Option(
        "--bench", metavar="FILE|NAME", help="Bench file, or a name that ships; the default is micron, emulated."
    ),
]
VirtualOption = Annotated[
    bool, typer.Option("--virtual", help="Virtual time: emulated benches only, deterministic, as fast as it can.")
]
RealtimeOption = Annotated[
    bool,
    typer.Option(
        "--realtime", help="Emulated bench: run on the wall clock, with the devices in processes of their own."
    ),
]
CompiledOption = Annotated[
    bool, typer.Option("--compiled", help="Run the ticks in one compiled thread without the interpreter.")
]
HandOption = Annotated[
    str | None,
    typer.Option(
        "--hand",
        metavar="FILE",
        help="Recorded hand that moves the emulated instrument, in place of the synthetic one.",
    ),
]
ScaleOption = Annotated[
    float | None,
    typer.Option(
        "--scale",
        min=1e-6,
        max=1e3,
        help="With --hand: factor on its motion; by default its tremor (8-12 Hz) becomes 50 um p-p.",
    ),
]
SeedOption = Annotated[
    int | None, typer.Option("--seed", min=0, help="Seed of the emulated world; default from the bench file.")
]


def pace_of(virtual: bool) -> Pace | None:
    """Return the pace that ``--virtual`` asks for; None paces an emulated bench and runs a real one in real time."""
    return "virtual" if virtual else None


def check_hand(hand: str | None) -> None:
    """Read the recorded hand of ``--hand`` before anything is compiled or opened. Raises ``HandFileError``."""
    if hand is not None:
        from sim_devices.plant.hand_file import load_hand

        load_hand(hand)


def bench_path(chosen: Path | str | None) -> Path:
    """Return the bench file that a path or the name of a shipped bench chooses. Raises ``InputError``.

    Where the file names code of other packages, the command goes on in a process of its own, and this call ends with
    its status.
    """
    from tools.cli.supervise import supervise
    from tools.emulate.shipped import bench_file

    file = bench_file("micron" if chosen is None else str(chosen))
    if chosen is not None:
        supervise(file)
    return file
