"""``micron tremor report``: the page on real hands."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from tools.cli.common import check_writable, clear_errors, console, write_text_atomic


def report(
    data: Annotated[Path, typer.Option(metavar="FOLDER", help="Folder of the real recordings.")] = Path(
        "../shared/data"
    ),
    out: Annotated[Path | None, typer.Option(metavar="FILE", help="Write the page (Markdown).")] = None,
) -> None:
    """Everything that is measured on recorded hands, as one page; minutes of computing.

    Example: micron tremor report --out docs/tremor-on-real-hands.md
    """
    from firmware_py.recording.revision import git_revision
    from tools.tremor.report import report as make

    with clear_errors():
        check_writable(out)
        with console().status("starting") as status:
            page = make(data, git_revision() or "unknown", lambda text: status.update(text))
        if out is None:
            typer.echo(page, nl=False)
        else:
            write_text_atomic(out, page)
            console().print(f"page: {out}")
