"""``micron tremor report``: the page on real hands."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Literal

import typer

from tools.cli.common import clear_errors, console
from tools.errors import InputError
from tools.output import check_writable
from tools.research.results.artefact import read_page, write_result


def report(
    data: Annotated[Path, typer.Option(metavar="FOLDER", help="Folder of the real recordings.")] = Path(
        "../shared/data"
    ),
    out: Annotated[
        Path | None, typer.Option(metavar="FILE", help="Write the result (FILE.json), or its page (FILE.md).")
    ] = None,
    section: Annotated[
        Literal["inspect", "evaluate", "published", "cascade", "detectors"] | None,
        typer.Option(help="Make this section of --out again and keep the others."),
    ] = None,
) -> None:
    """Make one page of everything that is measured on recorded hands, in minutes of computing.

    Example: micron tremor report --out docs/results/tremor-on-real-hands.json

    Example: micron tremor report --section evaluate --out docs/results/tremor-on-real-hands.json
    """
    from tools.research.stamp import revision_and_day
    from tools.research.tremor.report import renewed
    from tools.research.tremor.report import report as make

    with clear_errors():
        check_writable(out)
        with console().status("starting") as status:
            revision = revision_and_day()
            if section is None:
                page = make(data, revision, status.update)
            elif out is None or not out.is_file():
                raise InputError("--section makes a part of a page again: name the page with --out FILE")
            else:
                page = renewed(read_page(out), section, data, revision, status.update)
        if out is None:
            typer.echo(page, nl=False)
        else:
            write_result(out, page)
            console().print(f"page: {out}")
