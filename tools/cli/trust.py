"""Implements ``micron trust``: the user's decisions about programs and files that other people's folders name."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Annotated

import typer

from hal.trust import decisions, decisions_file, forget_all
from tools.cli.common import clear_errors, console, data_console
from tools.errors import InputError

TrustOption = Annotated[
    bool, typer.Option("--trust", help="Run the programs that the given file names, now and later (docs/security.md).")
]
OutsideOption = Annotated[
    bool, typer.Option("--allow-outside", help="Let the given file name files outside its folder, now and later.")
]


def decide_on(paths: list[Path], run: bool, outside: bool) -> None:
    """Record what the options allow for all that ``paths`` name; on a terminal, ask about the rest.

    What stays undecided is refused by whatever would use it.
    """
    from tools.programs import Program, named_in

    for path in paths:
        if not path.exists():
            continue  # the command says what is wrong with it
        for item in named_in(path):
            if item.is_trusted:
                continue
            if isinstance(item, Program):
                question = f"{item.named_by} names the program {item}. Run it, now and later?"
                if run or _says_yes(question):
                    item.trust()
            else:
                question = f"{item.named_by} names a file outside its folder: {item}. Read it, now and later?"
                if outside or _says_yes(question):
                    item.trust()


def _says_yes(question: str) -> bool:
    if sys.stdin is None or not sys.stdin.isatty():
        return False
    return typer.confirm(question, default=False, err=True)


def trust(
    paths: Annotated[
        list[Path] | None,
        typer.Argument(
            metavar="PATH...",
            help="A recording, twin, bench, folder, .py or .fmu; without it the decisions are listed.",
        ),
    ] = None,
    allow_outside: OutsideOption = False,
    forget: Annotated[bool, typer.Option("--forget", help="Drop every decision.")] = False,
) -> None:
    """Let the programs run that a recording, a twin or a bench names; without PATH, list what was decided.

    A decision about a file holds for its content: when the file changes, it is asked for again.

    Example: micron trust recordings/from-a-stranger
    """
    with clear_errors():
        if forget:
            if paths:
                raise InputError("--forget drops every decision; leave the paths out")
            console().print(f"{forget_all()} decisions dropped")
            return
        if not paths:
            days: dict[tuple[str, str], list[str]] = {}
            for decision in decisions():
                days.setdefault((decision.act, decision.label), []).append(decision.day)
            for (act, label), dates in days.items():
                what = "may run" if act == "run" else "may be named"
                versions = f" ({len(dates)} versions)" if len(dates) > 1 else ""
                data_console().print(f"{dates[-1]} {what}: {label}{versions}", soft_wrap=True)
            console().print(f"kept in {decisions_file()}", soft_wrap=True)
            return
        from tools.programs import Program, named_in

        for path in paths:
            if not path.exists():
                raise InputError(
                    f"{path}: there is no such file or folder; name a recording, a twin, a bench or a program"
                )
        for path in paths:
            programs = [item for item in named_in(path) if not (isinstance(item, Program) and item.is_ours)]
            for item in programs:
                is_program = isinstance(item, Program)
                if not is_program and not allow_outside and not item.is_trusted:
                    console().print(f"{item}: outside the folder; --allow-outside lets it be named", soft_wrap=True)
                    continue
                item.trust()
                console().print(f"{item}: may {'run' if is_program else 'be named'}", soft_wrap=True)
            if not programs:
                console().print(f"{path}: names no program of others and no file outside its folder", soft_wrap=True)
