"""Implements ``micron read``: it takes one reading of every sensor of other packages."""

from __future__ import annotations

from tools.cli.bench_option import BenchOption, VirtualOption, bench_path, pace_of
from tools.cli.common import JsonOption, clear_errors, data_console
from tools.output import check_writable, write_json
from tools.terminal import table_of


def read(bench: BenchOption = None, virtual: VirtualOption = False, json_file: JsonOption = None) -> None:
    """Take one reading of every sensor whose driver is from an installed package; nothing is armed.

    Example: micron read --bench lab.toml
    """
    from tools.diagnose.opened import opened_bench
    from tools.diagnose.read import read_sensors

    with clear_errors():
        check_writable(json_file)
        with opened_bench(bench_path(bench), pace=pace_of(virtual)) as opened:
            values = read_sensors(opened)
        if json_file != "-":
            table = table_of(None, "device", "identity", "quantity", "value", "unit", left=5)
            for v in values:
                table.add_row(v.device, v.identity, v.quantity, f"{v.value:.6g}", v.unit)
            data_console().print(table)
        write_json({"format": 1, "values": [v.as_dict() for v in values]}, json_file)
