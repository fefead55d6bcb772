"""``--bench FILE``, the same in every command."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

BenchOption = Annotated[
    Path | None, typer.Option("--bench", metavar="FILE", help="Bench file; the default is the emulated bench.")
]


def bench_path(chosen: Path | None) -> Path:
    """The chosen bench, or the one that ships with the package."""
    import benches

    return chosen if chosen is not None else Path(benches.__file__).with_name("micron.toml")
