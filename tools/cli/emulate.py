"""Implements ``micron emulate``: it serves a bench's emulated devices to any program."""

from __future__ import annotations

import os
import shutil
import signal
import subprocess
import time
from types import FrameType
from typing import TYPE_CHECKING, Annotated

import typer

from hal.bench import load_bench
from tools.cli.bench_option import bench_path
from tools.cli.common import JsonOption, clear_errors, console, data_console, print_note
from tools.errors import InputError
from tools.output import check_writable, write_json
from tools.terminal import table_of

if TYPE_CHECKING:
    from tools.emulate.world import Served

LOOK_S = 0.2


def _end(number: int, frame: FrameType | None) -> None:
    """End the command in order, with the world and its sockets, when a CI job sends SIGTERM."""
    raise SystemExit(128 + number)


def emulate(
    bench: Annotated[
        str | None,
        typer.Argument(metavar="[BENCH]", help="Bench file, or the name of one that ships (imus)."),
    ] = None,
    command: Annotated[
        list[str] | None,
        typer.Argument(metavar="[-- COMMAND...]", help="A program to run on these buses."),
    ] = None,
    tcp: Annotated[
        int | None,
        typer.Option("--tcp", metavar="PORT", min=0, max=65000, help="Serial buses on TCP ports, too; 0: free ones."),
    ] = None,
    can: Annotated[
        list[str] | None,
        typer.Option("--can", metavar="INTERFACE", help="CAN interfaces, in the order of the buses. Default: vcan*."),
    ] = None,
    stimulus: Annotated[
        list[str] | None,
        typer.Option(metavar="PART.CHANNEL=FILE:COLUMN", help="Play a recorded column into a part; may be repeated."),
    ] = None,
    json_file: JsonOption = None,
) -> None:
    """Serve every bus of a bench's emulated devices for any program, until Ctrl-C or until COMMAND ends.

    Serial devices are on a pty (and with --tcp on socket:// and rfc2217://), I2C chips on /dev/i2c-N for programs that
    are started with the variables shown (or as COMMAND), CAN nodes on vcan or UDP multicast. A socket takes orders: set
    and read what parts sense, inject faults, pause time (docs/emulate.md).

    Example: micron emulate imus -- printenv MICRON_I2C0
    """
    from tools.emulate.stimulus import read_stimulus
    from tools.emulate.world import serve

    status = 0
    with clear_errors():
        check_writable(json_file)
        program = None if not command else shutil.which(command[0])
        if command and program is None:
            raise InputError(f"{command[0]}: no such program; name one that is on the PATH, or its path")
        file = load_bench(bench_path(bench))
        buses = [bus.kind for bus in file.description.bus.values()]
        have = buses.count("can")
        if len(can or ()) > have:
            raise InputError(
                f"--can: {file.path} has {have} CAN {'bus' if have == 1 else 'buses'}; name no more interfaces"
            )
        if tcp is not None and "serial" not in buses:
            raise InputError(f"--tcp belongs to serial buses, and {file.path} has none; leave it out")
        columns = [read_stimulus(text) for text in stimulus or ()]
        signal.signal(signal.SIGTERM, _end)
        with serve(file, tcp_port=tcp, can=can, stimuli=columns, needs_shim=bool(command)) as served:
            write_json(served.as_dict(), json_file)
            for note in served.notes:
                print_note(note)
            if command:
                status = subprocess.call([str(program), *command[1:]], env={**os.environ, **served.environment})
            else:
                if json_file != "-":
                    _print(served)
                while served.world.alive():
                    time.sleep(LOOK_S)
                raise InputError("the emulated world has ended by itself; start it again, and report what its log says")
    if status:
        raise typer.Exit(status if status > 0 else 128 - status)


def _print(served: Served) -> None:
    table = table_of(None, "bus", "kind", "parts", "where", left=4, box=None, pad_edge=False)
    for bus in served.buses:
        table.add_row(bus.name, bus.kind, ", ".join(bus.parts), "\n".join(bus.places))
    out = data_console()
    out.print(table)
    out.print("control", str(served.world.control_path), soft_wrap=True)
    if "LD_PRELOAD" in served.environment:
        out.print("for /dev/i2c-N, start your program with", soft_wrap=True)
        for name in ("LD_PRELOAD", "MICRON_I2C"):
            out.print(f"  {name}={served.environment[name]}", soft_wrap=True)
    console().print("Ctrl-C ends it.")
