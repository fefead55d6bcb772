"""Implements ``micron data``: it lists and fetches the public recordings that documents and tests mention."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from tools.cli.common import Exit, JsonOption, clear_errors, console, data_console, print_error, print_whole
from tools.errors import InputError
from tools.output import check_names, check_writable, write_json

data = typer.Typer(help="List and fetch public recordings, each with its licence and checksum.")

CacheOption = Annotated[
    Path | None, typer.Option("--cache", metavar="FOLDER", help="Default: MICRON_DATA, else the user's cache folder.")
]


@data.command("list")
def list_sets(cache: CacheOption = None, json_file: JsonOption = None) -> None:
    """List the public recordings with licence, size, and whether they are in the cache.

    Example: micron data list
    """
    with clear_errors():
        check_names(cache)
        check_writable(json_file)
        from rich.table import Table

        from tools.data.fetch import is_whole
        from tools.data.registry import cache_folder, public_sets

        folder = cache or cache_folder()
        sets = public_sets().values()
        here = {s.name: sum(is_whole(folder / s.name / f.name, f) for f in s.files) for s in sets}
        if json_file != "-":
            full, narrow = Table(box=None, pad_edge=False), Table(box=None, pad_edge=False)
            for heading in ("name", "here", "MB", "licence", "what", "citation"):
                full.add_column(heading)
                if heading in ("name", "here", "MB", "licence"):
                    narrow.add_column(heading, overflow="fold")
            for s in sets:
                row = (s.name, f"{here[s.name]}/{len(s.files)}", f"{s.bytes / 1e6:.1f}", s.licence)
                full.add_row(*row, s.title, s.citation)
                narrow.add_row(*row[:3], row[3].partition(" (")[0])
            print_whole(full, narrow)
        console().print(f"cache: {folder}", soft_wrap=True)
        write_json(
            {
                "format": 1,
                "cache": str(folder),
                "sets": [
                    {
                        "name": s.name, "title": s.title, "licence": s.licence, "citation": s.citation,
                        "files": [
                            {"name": f.name, "url": s.url(f), "bytes": f.bytes, "sha256": f.sha256} for f in s.files
                        ],
                        "files_here": here[s.name],
                    }
                    for s in sets
                ],
            },
            json_file,
        )  # fmt: skip


@data.command("fetch")
def fetch_sets(
    names: Annotated[list[str], typer.Argument(metavar="NAME...", help="Names that 'micron data list' prints.")],
    cache: CacheOption = None,
    mirror: Annotated[str, typer.Option(metavar="URL", help="Take URL/NAME/FILE instead of the original places.")] = "",
    json_file: JsonOption = None,
) -> None:
    """Download public recordings into the cache. A file with the right checksum is not downloaded again.

    Example: micron data fetch emps
    """
    with clear_errors():
        check_names(cache)
        check_writable(json_file)
        if mirror and not mirror.startswith(("http://", "https://")):
            raise InputError(f"--mirror {mirror}: must begin with http:// or https://")
        from tools.data.fetch import Missing, fetch
        from tools.data.registry import cache_folder, named

        folder = cache or cache_folder()
        missing: list[Missing] = []
        files: dict[str, list[str]] = {}
        for wanted in named(names):
            fetched, lost = fetch(wanted, folder, mirror, lambda text: console().print(text, soft_wrap=True))
            missing += lost
            files[wanted.name] = [str(path) for path in fetched]
            for path in fetched:
                if json_file != "-":
                    data_console().print(str(path), soft_wrap=True)
            console().print(f"{wanted.name}: licence {wanted.licence}; cite: {wanted.citation}", soft_wrap=True)
        write_json({"format": 1, "cache": str(folder), "files": files}, json_file)
        if missing:
            places = "\n".join(f"  {m.url}\n    as {m.path}" for m in missing)
            reasons = "; ".join(dict.fromkeys(m.why for m in missing))
            print_error(
                f"{len(missing)} files could not be downloaded: {reasons}.\nWith another machine, get\n{places}\n"
                "and repeat this command: it checks what is there."
            )
            raise typer.Exit(Exit.FAILED)
