"""Defines the entry point: the list of commands, ``--version``, and nothing else.

A command's modules are imported when it is called, not to print the list: with all of them, physics, kernels and
statistics included, ``micron --help`` took seconds. What the list says of a command is the first sentence of its own
help, read from the source.
"""

from __future__ import annotations

import ast
import os
import sys
from importlib import import_module
from importlib.util import find_spec
from math import isfinite
from pathlib import Path
from typing import Annotated, Any, NamedTuple, NoReturn

import typer
from typer.core import TyperGroup

from firmware_py.exit_codes import Exit
from hal.children import SUPERVISED, use_one_thread
from tools.errors import FULL
from tools.interrupt import install_handler, was_interrupted


class Command(NamedTuple):
    """Describes a line of the list of commands."""

    panel: str
    where: str
    """``module:attribute``; the module is imported when the command is called."""

    @property
    def line(self) -> str:
        """The first sentence of the command's own help, read from its source without an import."""
        module, _, attribute = self.where.partition(":")
        source = Path(__file__).parents[2] / f"{module.replace('.', '/')}.py"
        helps: dict[str, str] = {}
        for node in ast.parse(source.read_text(encoding="utf-8")).body:
            match node:
                case ast.FunctionDef(name=name):
                    helps[name] = ast.get_docstring(node) or ""
                case ast.Assign([ast.Name(id=name)], ast.Call(keywords=[ast.keyword("help", ast.Constant(text)), *_])):
                    helps[name] = str(text)
        return " ".join(helps[attribute].split("\n\n")[0].split())


COMMANDS = {
    name: Command(panel, f"tools.cli.{where}")
    for panel, rows in {
        "Run": {
            "run": "run:run",
            "bench": "bench:bench",
            "simulate": "simulate:simulate_command",
            "replay": "replay:replay",
            "emulate": "emulate:emulate",
            "trust": "trust:trust",
        },
        "Look": {
            "doctor": "doctor:doctor",
            "scan": "diagnose:scan",
            "read": "read:read",
            **{name: f"diagnose:{name}" for name in ("scope", "dump", "log", "latency", "ramp", "capture")},
            "export": "recordings:export",
            "recover": "recordings:recover",
        },
        "Calibrate": {"calibrate": "calibrate:calibrate", "imu": "imu:imu", "noise": "noise:noise"},
        "Mismatch": {"mismatch": "mismatch:app", "data": "data:data"},
    }.items()
    for name, where in rows.items()
}
RESEARCH = (
    *("hands", "faults", "soak", "endoscope", "reproduce", "placement", "manipulator", "sensing", "tremor"),
    *("mismatch prove", "mismatch calibrate"),
)
"""Commands that only a source tree has."""
INSIDE: dict[str, dict[str, str]] = {}
"""Commands of research inside a group of the product: group -> name -> where it is."""
if find_spec("tools.research") is not None:  # a source tree; the wheel does not contain it
    _research = import_module("tools.research.cli.commands")
    COMMANDS |= {name: Command("Research", where) for name, where in _research.COMMANDS.items()}
    INSIDE |= _research.INSIDE


LIST_LINE = 90
"""Longest line, in characters, that a help text has on purpose, as in a list of commands."""


def _at(where: str) -> Any:
    module, _, attribute = where.partition(":")
    return getattr(import_module(module), attribute)


def load(name: str) -> Any:
    """Import the modules of the command ``name`` and return it, as typer makes it."""
    target = _at(COMMANDS[name].where)
    for inner, where in INSIDE.get(name, {}).items():
        if inner not in {command.name for command in target.registered_commands}:
            target.command(inner, rich_help_panel="Research")(_at(where))
    around = typer.Typer(rich_markup_mode="rich")
    if isinstance(target, typer.Typer):
        around.add_typer(target, name=name, cls=Helpful)
    else:
        around.command(name)(target)
    return _with_finite_numbers(_with_brackets(typer.main.get_group(around).commands[name]))


def _with_brackets(command: Any) -> Any:
    """Escape the help of ``command`` and return it: typer reads help as rich markup and leaves ``[firmware]`` out."""
    from rich.markup import escape

    command.help = escape(_rejoin(command.help)) if command.help else command.help
    for parameter in command.params:
        if getattr(parameter, "help", None):
            parameter.help = escape(parameter.help)
    for inner in getattr(command, "commands", {}).values():
        _with_brackets(inner)
    return command


def _with_finite_numbers(command: Any) -> Any:
    """Let ``command`` refuse options that are nan or infinite, and return it: nan passes the ranges of typer."""
    invoke = command.invoke

    def checked(ctx: Any) -> Any:
        for parameter in command.params:
            value = ctx.params.get(parameter.name)
            for number in value if isinstance(value, list | tuple) else [value]:
                if isinstance(number, float) and not isfinite(number):
                    typer.echo(f"micron: {parameter.opts[0]} {number}: is no finite number; give one", err=True)
                    ctx.exit(Exit.BAD_INPUT)
        return invoke(ctx)

    command.invoke = checked
    for inner in getattr(command, "commands", {}).values():
        _with_finite_numbers(inner)
    return command


def _rejoin(text: str) -> str:
    """Return ``text`` with the lines joined that the width of a source file has cut; short lines stay apart."""
    joined, before = "", ""
    for line in text.splitlines():
        joined += (" " if line and len(before) > LIST_LINE else "\n") + line
        before = line
    return joined.strip()


class Helpful(TyperGroup):
    """Answers a call without arguments with the help on standard output and exit status 0, and a command that only a
    source tree has with where it is.
    """

    def resolve_command(self, ctx: Any, args: list[str]) -> tuple[str | None, Any, list[str]]:
        if args[0] not in self.commands:
            name = " ".join([*ctx.command_path.split()[1:], args[0]])
            if name in RESEARCH:
                typer.echo(f"micron: '{name}' is a command of the source tree; an installed wheel lacks it", err=True)
                ctx.exit(Exit.BAD_INPUT)
        return super().resolve_command(ctx, args)

    def parse_args(self, ctx: Any, args: list[str]) -> list[str]:
        if not args:
            typer.echo(ctx.get_help())
            ctx.exit()
        return super().parse_args(ctx, args)


class OnDemand(Helpful):
    """Loads a command when it is called; until then it is a line of help."""

    def format_help(self, ctx: Any, formatter: Any) -> None:
        for name, command in self.commands.items():
            command.help = command.help or COMMANDS[name].line
        super().format_help(ctx, formatter)

    def resolve_command(self, ctx: Any, args: list[str]) -> tuple[str | None, Any, list[str]]:
        name, line, rest = super().resolve_command(ctx, args)
        return name, line if name is None else load(name), rest


def _version(wanted: bool) -> None:
    if wanted:
        from importlib.metadata import version

        typer.echo(f"micron {version('micron-bench')}")
        raise typer.Exit


def options(
    show_version: Annotated[
        bool, typer.Option("--version", callback=_version, is_eager=True, help="Print the version and exit.")
    ] = False,
) -> None:
    """Firmware and bench of a handheld instrument that cancels tremor.

    First steps, without any device:

    micron doctor: what this machine offers, what is missing
    micron run: the instrument for ten seconds, with a picture at its end
    micron bench: its page in a browser
    micron COMMAND --help: each command, with an example

    Ctrl-C stops a command: what was measured is printed and written (exit status 130). Twice, it ends at once.
    """


app = typer.Typer(
    name="micron",
    cls=OnDemand,
    callback=options,
    add_completion=False,
    rich_markup_mode="rich",
    pretty_exceptions_enable=False,
)
for _name, _command in COMMANDS.items():
    app.command(_name, rich_help_panel=_command.panel)(lambda: None)


def _end(message: str, code: Exit) -> NoReturn:
    sys.stderr.write(f"micron: {message}\n")
    raise SystemExit(code)


def main() -> None:
    """Run the ``micron`` script."""
    use_one_thread()
    install_handler()
    handle = None
    try:
        Path.cwd()
    except OSError as error:
        _end(f"the working folder cannot be used ({error.strerror}); change to another one", Exit.BAD_INPUT)
    if SUPERVISED in os.environ:
        from tools.cli.supervise import begin_supervised

        handle = begin_supervised()
    try:
        app()
    except OSError as error:
        if error.errno not in FULL:
            raise
        _end(f"standard output: cannot be written ({error.strerror}); free some space", Exit.FAILED)
    except BaseException as end:
        if not was_interrupted() or (isinstance(end, SystemExit) and end.code == Exit.INTERRUPTED):
            raise
        # Ctrl-C while a command was still being imported: compiled modules make an ImportError of it
        sys.stderr.write("micron: stopped by Ctrl-C\n")
        raise SystemExit(Exit.INTERRUPTED) from None
    finally:
        if handle is not None:
            os.write(handle, b".")  # the end is ours, not that of code that the bench names


if __name__ == "__main__":
    main()
