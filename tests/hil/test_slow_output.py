"""An amplifier that takes fewer commands than there are ticks: what it passes over is counted, not called sent."""

from __future__ import annotations

import pytest

from firmware_py.app import run_in_process
from firmware_py.run_request import RunRequest
from tools.cli.bench_option import bench_path
from tools.reports.run_report import summary_lines


def test_only_what_left_is_counted_and_timed():
    """115200 baud carry a command every 10 ms."""
    bench = bench_path(None).with_name("micron-e727.toml")
    outcome, _ = run_in_process(RunRequest(bench, 2.0, pace="virtual"))
    commands = outcome["commands"]
    assert commands["sent"] > 100
    assert commands["superseded"] == pytest.approx(9 * commands["sent"], abs=10)
    assert outcome["latency"]["sample_to_command_us"]["n"] == commands["sent"]
    result = outcome | {"realtime": "", "recording": None, "voluntary": {"gain": None}}
    said = [line for line in summary_lines(result) if "slower" in line]
    assert [f"{commands['sent']} commands sent, {commands['superseded']} passed over" in line for line in said] == [
        True
    ]
