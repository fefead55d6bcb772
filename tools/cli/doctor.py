"""``micron doctor``: what this machine offers, what the bench file asks for, what is missing and how to get it."""

from __future__ import annotations

from dataclasses import asdict

import typer
from rich.table import Table
from rich.text import Text

from hal.bench import load_bench
from tools.cli.bench_option import BenchOption, bench_path
from tools.cli.common import Exit, JsonOption, clear_errors, data_console
from tools.diagnose.findings import bench_findings, machine_findings
from tools.output import check_writable, write_json


def doctor(
    bench: BenchOption = None,
    json_file: JsonOption = None,
) -> None:
    """What this machine offers, what the bench asks for, what is missing and how to get it.

    Example: micron doctor --bench micron
    """
    with clear_errors():
        check_writable(json_file)
        findings = machine_findings() + bench_findings(load_bench(bench_path(bench)))
        missing = [f for f in findings if f.verdict == "missing"]
        if json_file != "-":
            table = Table(title="micron doctor", title_justify="left")
            for column in ("part", "verdict", "found", "what to do"):
                table.add_column(column, overflow="fold")
            colours = {"ok": "green", "limited": "yellow", "missing": "red"}
            for finding in findings:
                colour = colours[finding.verdict]
                table.add_row(finding.part, Text(finding.verdict, colour), finding.detail, finding.remedy)
            data_console().print(table)
        write_json({"format": 1, "findings": [asdict(f) for f in findings], "missing": len(missing)}, json_file)
        if missing:
            raise typer.Exit(Exit.DEVICE_MISSING)
