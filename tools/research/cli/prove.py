"""``micron mismatch prove`` and ``calibrate``: how right the engine is, on recordings whose answers are sealed."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Annotated, cast

import typer

from tools.cli.common import JsonOption, clear_errors, console, data_console
from tools.errors import InputError
from tools.output import check_folder, check_writable, write_json


def _say(text: str) -> None:
    console().print(text, soft_wrap=True)


def prove(
    cases: Annotated[int, typer.Option(min=1, help="Recordings to draw.")] = 40,
    seed: Annotated[
        int | None, typer.Option(min=0, help="Seed of the cases; a new one is drawn and printed if left out.")
    ] = None,
    json_file: JsonOption = None,
    jobs: Annotated[int | None, typer.Option(min=1, help="Number of processes; default: one per core.")] = None,
    keep: Annotated[
        Path | None,
        typer.Option(
            metavar="FOLDER", help="Folder of recordings, sealed answers and reports; a stopped run goes on there."
        ),
    ] = None,
    corpus: Annotated[
        str | None, typer.Option(metavar="NAME", help="calibrate, develop or sealed: exact scores on its own seeds.")
    ] = None,
    samples: Annotated[int, typer.Option(min=500, help="Most samples of a recording of a corpus.")] = 8000,
    minutes: Annotated[
        float | None, typer.Option(min=0.0, help="With --corpus: begin no case after these; run again to go on.")
    ] = None,
    first: Annotated[int, typer.Option(min=0, help="With --corpus: the number of the first case.")] = 0,
) -> None:
    """Draw recordings with sealed answers, diagnose them, open the seal and print the table: a blind self-proof.

    Example: micron mismatch prove --cases 40 --seed 1
    """
    with clear_errors():
        check_writable(json_file)
        check_folder(keep, "--keep")
        if keep is not None:
            keep.mkdir(exist_ok=True)
        if corpus is not None:
            if seed is not None:
                raise InputError("--corpus has seeds of its own; leave --seed out")
            _prove_corpus(corpus, cases, first, samples, minutes, jobs, keep, json_file)
            return

        from tools.research.prove import prove as run_proof
        from tools.research.prove.runner import tool
        from tools.research.prove.table import show

        processes = jobs or os.cpu_count() or 1
        result = run_proof(cases, seed, processes, keep, max_samples=samples, diagnose=tool, progress=_say)
        show(result, data_console(json_file))
        write_json(result.to_json(), json_file)


def _prove_corpus(
    corpus: str,
    cases: int,
    first: int,
    samples: int,
    minutes: float | None,
    jobs: int | None,
    keep: Path | None,
    json_file: str | None,
) -> None:
    from contextlib import ExitStack
    from tempfile import TemporaryDirectory

    from tools.research.prove.corpus import NAMES, Name
    from tools.research.prove.corpus_table import corpus_table
    from tools.research.prove.harness import Run, run_corpus

    if corpus not in NAMES:
        raise InputError(f"--corpus {corpus}: there is no such corpus; use {', '.join(NAMES)}")
    limit = float("inf") if minutes is None else minutes
    run = Run(cast(Name, corpus), cases, samples, limit, jobs or os.cpu_count() or 1, first)
    with ExitStack() as stack:
        folder = keep or Path(stack.enter_context(TemporaryDirectory(prefix="micron-corpus-")))
        result = run_corpus(run, folder, progress=_say)
    data_console(json_file).print(corpus_table(result))
    write_json(result.to_json(), json_file)


def calibrate(
    keep: Annotated[
        Path,
        typer.Option(
            "--keep", metavar="FOLDER", help="Folder of cases and their fits; an interrupted run goes on there."
        ),
    ],
    cases: Annotated[int, typer.Option(min=8, help="Cases of the calibrate corpus.")] = 120,
    samples: Annotated[int, typer.Option(min=500, help="Most samples of a recording.")] = 8000,
    minutes: Annotated[
        float | None, typer.Option(min=0.0, help="Begin no case after these minutes; run again to go on.")
    ] = None,
    partial: Annotated[bool, typer.Option("--partial", help="Learn from the cases that are finished so far.")] = False,
    json_file: JsonOption = None,
) -> None:
    """Learn the constants of the engine from the calibrate corpus and write them with their provenance.

    Example: micron mismatch calibrate --keep calibration
    """
    with clear_errors():
        check_writable(json_file)
        check_folder(keep, "--keep")
        keep.mkdir(exist_ok=True)
        from tools.research.prove.calibration import calibrate as run_calibration
        from tools.research.prove.calibration import write_constants

        limit = float("inf") if minutes is None else minutes
        body, left = run_calibration(keep, cases, samples, limit, partial=partial, progress=_say)
        if body is None:
            if not left:
                raise InputError(f"--cases {cases}: too few of them can be searched to learn from; take more cases")
            _say(f"{left} of {cases} cases are still to be done; run the same command again")
            return
        file = write_constants(body)
        _say(f"constants written: {file}")
        write_json(body, json_file)
