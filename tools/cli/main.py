"""Defines the entry point: the list of commands, ``--version``, and nothing else.

A command's modules are imported when it is called, not to print the list: with all of them, physics, kernels and
statistics included, ``micron --help`` took seconds. What the list says of a command is the first sentence of its own
help (a test compares them).
"""

from __future__ import annotations

import os
import sys
from importlib import import_module
from importlib.util import find_spec
from typing import Annotated, Any, NamedTuple

import typer
from typer.core import TyperGroup

from firmware_py.exit_codes import Exit
from hal.children import SUPERVISED, use_one_thread
from tools.interrupt import install_handler, was_interrupted


class Command(NamedTuple):
    """Describes a line of the list of commands."""

    panel: str
    where: str
    """``module:attribute``; the module is imported when the command is called."""
    line: str


COMMANDS = {
    "run": Command(
        "Run", "tools.cli.run:run", "Run the instrument in closed loop and report what was left of the tremor."
    ),
    "bench": Command(
        "Run", "tools.cli.bench:bench", "Run the instrument and serve the bench page for it, until Ctrl-C."
    ),
    "simulate": Command(
        "Run",
        "tools.cli.simulate:simulate_command",
        "Simulate the closed loop without wires, tens of times faster than real time; the same figures as micron run.",
    ),
    "replay": Command(
        "Run",
        "tools.cli.replay:replay",
        "Run the firmware over a recording and compare every estimate and command with the recorded one, bit for bit.",
    ),
    "emulate": Command(
        "Run",
        "tools.cli.emulate:emulate",
        "Serve every bus of a bench's emulated devices for any program, until Ctrl-C or until COMMAND ends.",
    ),
    "trust": Command(
        "Run",
        "tools.cli.trust:trust",
        "Let the programs run that a recording, a twin or a bench names; without PATH, list what was decided.",
    ),
    "doctor": Command(
        "Look",
        "tools.cli.doctor:doctor",
        "Check what this machine offers and what the bench asks for, and say how to get what is missing.",
    ),
    "scan": Command(
        "Look",
        "tools.cli.diagnose:scan",
        "List the machine's ports, the I2C addresses that answer and the CAN traffic; exit 4 when a declared I2C "
        "device is silent.",
    ),
    "read": Command(
        "Look",
        "tools.cli.read:read",
        "Take one reading of every sensor whose driver is from an installed package; nothing is armed.",
    ),
    "scope": Command(
        "Look",
        "tools.cli.diagnose:scope",
        "Draw the analog inputs as lines in the terminal; outputs are not armed. Exit 3 when scans were lost.",
    ),
    "dump": Command(
        "Look",
        "tools.cli.diagnose:dump",
        "Print CAN frames as they come, decoded where the id is known; nothing is sent.",
    ),
    "log": Command(
        "Look",
        "tools.cli.diagnose:log",
        "Print what a running 'micron bench' says, as it says it. Exit 4 when there is none.",
    ),
    "latency": Command(
        "Look",
        "tools.cli.diagnose:latency",
        "Measure how late a 1 kHz loop is on this machine: in C, compiled, in Python, with a pty, as the firmware.",
    ),
    "ramp": Command(
        "Look",
        "tools.cli.diagnose:ramp",
        "Step the outputs over their full range and read each step back. Exit 1 when one is off.",
    ),
    "capture": Command(
        "Look",
        "tools.cli.diagnose:capture",
        "Record what goes over every bus while the drivers open the bench and scan, or replay such a transcript.",
    ),
    "export": Command(
        "Look",
        "tools.cli.recordings:export",
        "Write a recording, or a span of it, as csv, npz, parquet, nc, mf4, mcap, or a folder for the mismatch engine.",
    ),
    "recover": Command(
        "Look",
        "tools.cli.recordings:recover",
        "Make a finished recording of what is sound in FILE and say exactly what is missing (exit 3 if anything is).",
    ),
    "calibrate": Command(
        "Calibrate", "tools.cli.calibrate:calibrate", "Identify sensors and stacks from calibration recordings."
    ),
    "imu": Command(
        "Calibrate",
        "tools.cli.imu:imu",
        "Measure offsets, stability, drift, noise and temperature dependence of an inertial sensor, from recordings or "
        "on a bench.",
    ),
    "noise": Command(
        "Calibrate",
        "tools.cli.noise:noise",
        "Compute the overlapping Allan deviation of a recording and fit white noise, flicker, random walk and ramp.",
    ),
    "mismatch": Command(
        "Mismatch",
        "tools.cli.mismatch:app",
        "Find where a simulation and a recording differ, and which physics the simulation lacks.",
    ),
    "data": Command(
        "Mismatch", "tools.cli.data:data", "List and fetch public recordings, each with its licence and checksum."
    ),
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
    COMMANDS |= {name: Command("Research", *row) for name, row in _research.COMMANDS.items()}
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
    return _with_brackets(typer.main.get_group(around).commands[name])


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
    app.command(_name, help=_command.line, rich_help_panel=_command.panel)(lambda: None)


def main() -> None:
    """Run the ``micron`` script."""
    use_one_thread()
    install_handler()
    handle = None
    if SUPERVISED in os.environ:
        from tools.cli.supervise import begin_supervised

        handle = begin_supervised()
    try:
        app()
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
