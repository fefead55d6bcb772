"""Implements ``micron mismatch heal``: it improves a bench by its own diagnosis."""

from __future__ import annotations

import shlex
from pathlib import Path
from typing import Annotated

import typer

from tools.cli.bench_option import bench_path
from tools.cli.common import JsonOption, clear_errors, console, data_console
from tools.output import check_folder, check_writable, write_json


def heal(
    bench: Annotated[str, typer.Argument(metavar="BENCH", help="An emulated bench: a file or a name that ships.")],
    out: Annotated[Path, typer.Option(metavar="FOLDER", help="Recordings, calibrations and the healed bench.")] = Path(
        "healed"
    ),
    seconds: Annotated[float, typer.Option(min=5.0, max=600.0, help="Length of each run that decides.")] = 12.0,
    runs: Annotated[
        int, typer.Option(min=3, max=100, help="Runs that try a remedy, each with its hand; twice as many decide.")
    ] = 8,
    max_effect: Annotated[
        int | None, typer.Option(min=0, max=4, help="On a real bench: 4 may move the outputs.")
    ] = None,
    json_file: JsonOption = None,
) -> None:
    """Measure each part of a bench, put right what the firmware believes of it, and keep what helps the tip.

    A remedy is kept when runs with other hands and noise have less error at 8-12 Hz or 2-500 Hz, and no band has more.

    Example: micron mismatch heal benches/micron.toml --out healed
    """
    with clear_errors():
        check_writable(json_file)
        check_folder(out)
        from hal.bench import load_bench

        path = bench_path(Path(bench))
        file = load_bench(path)
        from tools.heal import heal as healing

        healing.check_bench(file, max_effect)
        out.mkdir(parents=True, exist_ok=True)
        found = healing.heal(path, out, seconds=seconds, runs=runs, say=lambda text: console().print(text))
        say = data_console(json_file)
        for line in healing.lines(found):
            say.print(line, highlight=False, markup=False, soft_wrap=True)
        if found.bench is not None:
            console().print(
                f"healed bench: {found.bench}; try: micron run --virtual --bench {shlex.quote(found.bench)}",
                soft_wrap=True,
            )
        write_json(found.to_json(), json_file)
