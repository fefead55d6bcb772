"""Implements ``micron doctor``: it compares this machine with the bench file and says how to get what is missing."""

from __future__ import annotations

from dataclasses import asdict
from pathlib import Path
from typing import Annotated

import typer
from rich.text import Text

from firmware_py.machine.settings import set_machine
from firmware_py.machine.tree import Tree
from firmware_py.run_request import serial_ports
from hal.bench import load_bench
from tools.cli.bench_option import BenchOption, bench_path
from tools.cli.common import Exit, JsonOption, clear_errors, console, data_console
from tools.diagnose.findings import bench_findings, machine_findings, setting_findings
from tools.errors import InputError
from tools.output import check_writable, write_json
from tools.terminal import table_of

WIDE = 100
"""Number of columns of a terminal below which the remedies get most of the width: a command to copy stays whole."""


def doctor(
    bench: BenchOption = None,
    set_up: Annotated[
        bool, typer.Option("--set", help="Set what slows a loop down and can be set, until the next start (root).")
    ] = False,
    root: Annotated[
        Path, typer.Option(hidden=True, help="Folder with another machine's /dev, /proc and /sys, for its settings.")
    ] = Path("/"),
    json_file: JsonOption = None,
) -> None:
    """Check what this machine offers and what the bench asks for, and say how to get what is missing.

    Example: micron doctor --bench micron
    """
    with clear_errors():
        check_writable(json_file)
        if not root.is_dir():
            raise InputError(f"--root {root}: there is no such folder; copy /proc and /sys of the machine there")
        file, tree = load_bench(bench_path(bench)), Tree(root)
        ports = serial_ports(file)
        changes = set_machine(tree, ports) if set_up else []
        for change in changes:
            end = f"refused: {change.failure}" if change.failure else f"now {change.wanted}"
            console().print(f"{change.name}, {change.what}: was {change.before}, {end}", soft_wrap=True)
        if set_up and not changes:
            console().print("nothing to set")
        findings = machine_findings() + setting_findings(tree, ports) + bench_findings(file)
        missing = [f for f in findings if f.verdict == "missing"]
        if json_file != "-":
            table = table_of(
                "micron doctor", "part", "verdict", "found", "what to do", left=4, box=None, pad_edge=False
            )
            if data_console().width < WIDE:
                table.columns[0].max_width, table.columns[2].max_width = 16, 20
            colours = {"ok": "green", "limited": "yellow", "missing": "red"}
            for finding in findings:
                colour = colours[finding.verdict]
                table.add_row(finding.part, Text(finding.verdict, colour), finding.detail, finding.remedy)
            data_console().print(table)
        result = {"format": 1, "findings": [asdict(f) for f in findings], "missing": len(missing)}
        write_json({**result, "set": [asdict(c) for c in changes]} if set_up else result, json_file)
        if missing:
            raise typer.Exit(Exit.DEVICE_MISSING)
