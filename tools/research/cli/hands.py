"""``micron hands``: the closed loop on recorded tremor, as a table."""

from __future__ import annotations

from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from hal.bench import load_bench
from tools.cli.bench_option import BenchOption, bench_path
from tools.cli.common import JsonOption, clear_errors, console
from tools.errors import InputError
from tools.interrupt import keep_what_is_there, need_some
from tools.output import check_writable, write_json
from tools.research.results.artefact import write_result
from tools.research.stamp import revision_and_day
from tools.terminal import spinner

if TYPE_CHECKING:
    from tools.reports.figures import TremorFigures
    from tools.research.reports.hand_limits import FineMotion


def hands(
    bench: BenchOption = None,
    data: Annotated[Path, typer.Option(metavar="FOLDER", help="Folder of the real recordings.")] = Path(
        "../shared/data"
    ),
    heldout: Annotated[
        Path | None,
        typer.Option(
            metavar="FOLDER", help="Score every recorded hand of this folder instead of the recordings of people."
        ),
    ] = None,
    people: Annotated[
        int,
        typer.Option(min=0, max=1000, help="Synthetic people to draw from the revision, too."),
    ] = 0,
    seconds: Annotated[float, typer.Option(min=8.0, max=600.0)] = 40.0,
    out: Annotated[
        Path | None, typer.Option(metavar="FILE", help="Write the result (FILE.json), or its page (FILE.md).")
    ] = None,
    json_file: JsonOption = None,
) -> None:
    """Run the instrument in every recorded hand, with each estimator, in virtual time, beside the limits.

    Example: micron hands --out docs/results/hands.json

    Hands that no setting has seen, with the bench's estimator: micron hands --heldout recordings
    """
    from tools.research.reports.hands import HandRow, draw_people, markdown, run_hands, run_people
    from tools.research.reports.hands_heldout import find_recordings, heldout_page, run_heldout

    with clear_errors():
        check_writable(json_file, out)
        file = load_bench(bench_path(bench))
        folder = None if heldout is None else find_recordings(heldout, file)
        if folder is None and not data.is_dir():
            raise InputError(f"{data}: no such folder; name the recordings with --data FOLDER")
        if heldout is not None and people:
            raise InputError("--people belongs to the page of the known hands; leave out --heldout")
        rows: list[HandRow] = []
        stamp = revision_and_day()
        seeds = draw_people(stamp.split(",")[0], people)
        synthetic: list[tuple[TremorFigures, FineMotion]] = []
        with spinner(console()) as show, keep_what_is_there():
            if folder is None:
                result = run_hands(file, data, seconds, show)
            else:
                result = run_heldout(file, folder, seconds, show)
            for row in result:
                rows.append(row)  # noqa: PERF402 - what is there when Ctrl-C comes is kept
            for person in run_people(file, seeds, seconds, show):
                synthetic.append(person)  # noqa: PERF402
        need_some(rows)
        page = (
            markdown(rows, seconds, stamp, synthetic, seeds)
            if folder is None
            else heldout_page(folder, rows, seconds, stamp, out)
        )
        if out is not None:
            write_result(out, page)
        if json_file != "-":
            typer.echo(page)
        found: dict[str, Any] = {"format": 1, "seconds": seconds, "rows": [row.as_dict() for row in rows]}
        if people:
            found["people"] = [
                {"seed": seed, **figures.to_json(), "above_20_Hz_at_8_kHz": asdict(fine)}
                for seed, (figures, fine) in zip(seeds, synthetic, strict=False)
            ]
        write_json(found, json_file)
