"""``--bench FILE``, the same in every command."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from hal.clock import Pace

BenchOption = Annotated[
    Path | None, typer.Option("--bench", metavar="FILE", help="Bench file; the default is the emulated bench.")
]
VirtualOption = Annotated[
    bool, typer.Option("--virtual", help="Virtual time: emulated benches only, deterministic, as fast as it can.")
]


def pace_of(virtual: bool) -> Pace | None:
    """Return the pace that ``--virtual`` asks for; None paces an emulated bench and runs a real one in real time."""
    return "virtual" if virtual else None


def bench_path(chosen: Path | None) -> Path:
    """The chosen bench, or the one that ships with the package. Where a chosen one names code that is not ours, the
    command goes on in a process of its own, and this call ends with its status.
    """
    import benches

    if chosen is None:
        return Path(benches.__file__).with_name("micron.toml")
    from tools.cli.supervise import supervise

    supervise(chosen)
    return chosen
