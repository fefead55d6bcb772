"""What all commands share: exit codes, ``--json``, consoles, and errors that become one clear line.

Exit codes (contracts/commands.md): 0 done, 1 failed, 2 bad usage or input, 3 finished but data was lost,
4 a declared device is missing.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from typing import Annotated

import typer
from rich.console import Console
from rich.markup import escape
from rich.measure import Measurement
from rich.table import Table

from firmware_py.exit_codes import Exit, exit_code_of
from hal.errors import HalError
from tools.errors import InputError, OutputError

JsonOption = Annotated[
    str | None, typer.Option("--json", metavar="FILE", help="Write the result as JSON; '-' is standard output.")
]


def console() -> Console:
    """For people: standard error."""
    return Console(stderr=True, highlight=False, emoji=False)


def data_console() -> Console:
    """For data: standard output."""
    return Console(highlight=False)


def print_whole(full: Table, narrow: Table | None = None) -> None:
    """``full`` to standard output, no cell cut: as wide as it must be in a file or pipe.

    A terminal that is too narrow for it gets ``narrow`` instead, and is told so.
    """
    out = data_console()
    needed = Measurement.get(out, out.options.update(max_width=1000), full).maximum
    if not out.is_terminal:
        out = Console(highlight=False, width=max(needed, out.width))
    elif narrow is not None and needed > out.width:
        out.print(narrow)
        console().print(f"{needed} columns show more than these {out.width}; so does --json FILE", soft_wrap=True)
        return
    out.print(full)


@contextmanager
def clear_errors() -> Iterator[None]:
    """Turn what went wrong into one message on standard error and the exit code of the contract."""
    try:
        yield
    except typer.Exit:
        raise
    except OutputError as error:
        _fail(error, Exit.FAILED)
    except InputError as error:
        _fail(error, Exit.BAD_INPUT)
    except HalError as error:
        _fail(error, exit_code_of(error))


def _fail(error: Exception, code: Exit) -> None:
    console().print(f"[bold red]micron:[/] {escape(str(error))}", soft_wrap=True)
    raise typer.Exit(code)
