"""Holds the parts that all commands share: exit codes, ``--json``, consoles, and errors as one clear line.

Exit codes (contracts/commands.md): 0 done, 1 failed, 2 bad usage or input, 3 finished but data was lost,
4 a declared device is missing, 5 the host was not fit for real time, 130 stopped by Ctrl-C.
"""

from __future__ import annotations

import shlex
import sys
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Annotated

import typer
from rich.console import Console
from rich.measure import Measurement
from rich.table import Table
from rich.text import Text

from firmware_py.exit_codes import Exit, exit_code_of
from hal.errors import HalError
from hal.trust import NotTrusted
from tools.errors import FULL, InputError, OutputError
from tools.interrupt import begin_command, is_stopped, note_stop
from tools.output import check_writable
from tools.terminal import plain_console

JsonOption = Annotated[
    str | None, typer.Option("--json", metavar="FILE", help="Write the result as JSON; '-' is standard output.")
]


PICTURES = (".png", ".svg", ".pdf", ".jpg")
"""Formats of a picture that is drawn with matplotlib, by the ending of its file."""
CIRCLE = "Symlink loop"
"""Beginning of what pathlib says, until Python 3.13, of links that run in a circle."""
DECIDING = (
    ("mismatch", "diagnose"),
    ("mismatch", "apply"),
    ("mismatch", "simulate"),
    ("mismatch", "watch"),
    ("mismatch", "plan"),
    ("run",),
    ("bench",),
)
"""The commands that take ``--trust`` and ``--allow-outside``."""


def console() -> Console:
    """Return the console for people, on standard error."""
    return plain_console(stderr=True)


def data_console(json_file: str | None = None) -> Console:
    """Return the console for data, on standard output; with ``--json -``, which takes that, the one for people."""
    return plain_console(stderr=json_file == "-")


def print_whole(full: Table, narrow: Table | None = None) -> None:
    """Print ``full`` on standard output without cutting a cell: as wide as it must be in a file or pipe.

    A terminal that is too narrow for it gets ``narrow`` instead, and is told so.
    """
    out = data_console()
    needed = Measurement.get(out, out.options.update(max_width=1000), full).maximum
    if not out.is_terminal:
        out = plain_console(width=max(needed, out.width))
    elif narrow is not None and needed > out.width:
        out.print(narrow)
        console().print(f"{needed} columns show more than these {out.width}; so does --json FILE", soft_wrap=True)
        return
    out.print(full)


def print_error(message: str) -> None:
    """Print ``micron: message`` on standard error."""
    console().print(Text.assemble(("micron:", "bold red"), " ", message), soft_wrap=True)


def print_note(message: str) -> None:
    """Print ``note: message`` on standard error."""
    console().print(Text.assemble(("note:", "yellow"), " ", message), soft_wrap=True)


def check_picture(path: Path | None, formats: Sequence[str] = PICTURES) -> None:
    """Refuse a picture whose ending is none of ``formats``: ``InputError``."""
    if path is not None and path.suffix.lower() not in formats:
        raise InputError(f"{path}: a picture ends in {' or '.join(formats)}; name such a file")


def check_recording_name(path: Path | None) -> None:
    """Refuse a name for a new recording that promises another format: ``InputError``."""
    if path is not None and path.suffix.lower() != ".mcap":
        raise InputError(f"{path}: a recording ends in .mcap; name such a file ('micron export' makes csv and others)")


def place_picture(
    chosen: Path | None, default: Path, *, formats: Sequence[str] = PICTURES, reads: Sequence[str | Path | None] = ()
) -> Path | None:
    """Return the file for a picture, checked before the work: ``chosen``, else ``default``, whose folder will be made.

    Raises InputError for a chosen one that cannot be written; for the default that is a note, and there is no picture.
    """
    if chosen is not None:
        check_writable(chosen, reads=reads)
        check_picture(chosen, formats)
        return chosen
    folder = default.parent
    while not folder.exists():
        folder = folder.parent
    try:
        check_writable(folder / default.name)
    except InputError as error:
        print_note(f"no picture will be written: {error}")
        return None
    return default


@contextmanager
def clear_errors() -> Iterator[None]:
    """Turn what went wrong into one message on standard error and the exit code of the contract; Ctrl-C too."""
    with begin_command():
        try:
            yield
        except KeyboardInterrupt:
            note_stop()
        except typer.Exit:
            if not is_stopped():
                raise
        except OutputError as error:
            _fail(error, Exit.FAILED)
        except InputError as error:
            _fail(error, Exit.BAD_INPUT)
        except NotTrusted as error:
            print_error(f"{error}.\n{_how_to_trust(error)}")
            raise typer.Exit(Exit.BAD_INPUT) from error
        except HalError as error:
            _fail(error, exit_code_of(error))
        except OSError as error:
            if error.errno in FULL:
                where = error.filename or "standard output"
                print_error(f"{where}: cannot be written ({error.strerror}); free some space")
                raise typer.Exit(Exit.FAILED) from error
            if error.filename is None:
                raise  # no file of a person; a reader of the pipe that went away, for one
            print_error(f"{error.filename}: cannot be used ({error.strerror}); name another file, or change its rights")
            raise typer.Exit(Exit.BAD_INPUT) from error
        except RuntimeError as error:
            if not str(error).startswith(CIRCLE):
                raise
            print_error(f"{error}: its links lead back to it; name a file that is there")
            raise typer.Exit(Exit.BAD_INPUT) from error
        except MemoryError as error:
            print_error(
                f"not enough memory: {error or 'nothing more could be allocated'}; end other programs, or ask for less"
            )
            raise typer.Exit(Exit.FAILED) from error
        if is_stopped():
            print_error("stopped by Ctrl-C")
            raise typer.Exit(Exit.INTERRUPTED)


def _how_to_trust(error: NotTrusted) -> str:
    """Return the command that permits what was refused: this one with its option, or micron trust."""
    if any(tuple(sys.argv[1 : 1 + len(command)]) == command for command in DECIDING):
        again = shlex.join(["micron", *sys.argv[1:], error.option])
        return f"If you trust its author, repeat: {again}"
    option = [] if error.option == "--trust" else [error.option]
    return f"If you trust its author: {shlex.join(['micron', 'trust', str(error.subject), *option])}; then repeat this"


def _fail(error: Exception, code: Exit) -> None:
    print_error(str(error))
    raise typer.Exit(code)
