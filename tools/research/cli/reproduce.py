"""Implements ``micron reproduce``: it computes published figures again and prints them beside ours."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Annotated, Any

import typer
from rich.table import Table as RichTable
from rich.text import Text

from tools.cli.common import JsonOption, clear_errors, console, data_console
from tools.errors import InputError
from tools.interrupt import keep_what_is_there, need_some
from tools.output import check_names, check_writable, write_json
from tools.research.results.artefact import write_result
from tools.research.stamp import revision_and_day


def reproduce(
    names: Annotated[list[str], typer.Argument(metavar="NAME...", help="Section: sensing, real-sensors, ... or all.")],
    out: Annotated[
        Path | None, typer.Option(metavar="FILE", help="Write the result (FILE.json), or its page (FILE.md).")
    ] = None,
    json_file: JsonOption = None,
    sets: Annotated[
        list[str] | None,
        typer.Option(
            "--set",
            metavar="NAME",
            help="Only sets of section measured with this in their name; --out keeps the rows of the others.",
        ),
    ] = None,
    rows: Annotated[
        Path | None,
        typer.Option(metavar="FILE", help="JSON of finished sets of section measured; a stopped run goes on there."),
    ] = None,
) -> None:
    """Compute published figures again and print them beside ours.

    Example: micron reproduce sensing --json out/sensing.json

    A result: micron reproduce sensing real-sensors --out docs/results/sensing.json

    Measured recordings, set by set: micron reproduce measured --set emps --rows out/measured.json
    """
    from tools.research.reproduce.names import check, expand, reproduce_table
    from tools.research.reproduce.page import markdown
    from tools.research.reproduce.rows import Table

    def show(table: Table) -> None:
        met = sum(row.meets for row in table.rows)
        grid = RichTable(
            title=f"{table.name}: {met} of {len(table.rows)} met, {table.seconds:.1f} s", title_justify="left"
        )
        grid.add_column("quantity (condition)", overflow="fold", ratio=1)
        for column in ("published", "ours"):
            grid.add_column(column, justify="right", no_wrap=True)
        for column in ("unit", "met"):
            grid.add_column(column, no_wrap=True)
        source = ""
        for row in table.rows:
            if row.source != source:
                source = row.source
                grid.add_row(Text(source, "bold"))
            sign = {"equal": "=", "lower": "<=", "higher": ">="}[row.better]
            why = ("\n" + row.why, "dim") if row.why else ""
            grid.add_row(
                Text.assemble(f"  {row.quantity} ({row.condition}; {row.kind})", why),
                f"{sign} {row.published:.4g}",
                f"{row.ours:.4g}" if math.isfinite(row.ours) else "-",
                row.unit,
                "yes" if row.meets else Text("no", "red"),
            )
        data_console().print(grid)
        for note in table.notes:
            console().print(note, soft_wrap=True)

    def ready(chosen: list[str]) -> list[str]:
        """Return the sections that can be computed here. Others are an error at once, or a note when all were asked
        for."""
        sections_here = []
        for name in chosen:
            try:
                check(name)
            except InputError as error:
                if "all" not in names:
                    raise
                console().print(f"left out: {error}", soft_wrap=True)
            else:
                sections_here.append(name)
        return sections_here

    with clear_errors():
        check_names(rows)
        check_writable(json_file, out)
        wanted = expand(names)
        options: dict[str, Any] = {}
        if sets or rows:
            options = {"only": tuple(sets or ()), "rows_file": rows}
        if options and wanted != ["measured"]:
            raise InputError("--set and --rows belong to 'micron reproduce measured' alone")
        if sets and out is not None and out.exists():
            options["before"] = out
        tables: list[Table] = []
        with keep_what_is_there():
            for name in ready(wanted):
                tables.append(reproduce_table(name, **options))
                show(tables[-1])
        need_some(tables)
        if out is not None:
            command = f"micron reproduce {' '.join(names)} --out {out}"
            text = tables[0].page if len(tables) == 1 and tables[0].page else ""
            write_result(out, text or markdown(tables, command, revision_and_day()))
        results = [table.as_dict() for table in tables]
        write_json(results[0] if len(results) == 1 else {"format": 1, "tables": results}, json_file)
