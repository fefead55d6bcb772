"""The peer of the wire benchmark answers every scan, on both kinds of output."""

from __future__ import annotations

import pytest

from benchmarks.bare import COMMANDS_HZ, measure
from benchmarks.wire import BUS_NS
from tools.cli.bench_option import bench_path

pytestmark = pytest.mark.realtime


def test_every_scan_gets_a_transfer_of_the_bus_time_at_least() -> None:
    bare = measure(bench_path(None), 0.2, 1000, polls=True)
    assert len(bare.late_us) == 200
    assert min(bare.late_us) >= BUS_NS * 1e-3
    assert 0.0 <= bare.without_command < 100.0


def test_a_serial_output_gets_as_many_commands_as_the_firmware_s() -> None:
    bare = measure(bench_path(None).with_name("micron-e727.toml"), 0.3, 1000)
    assert len(bare.late_us) == 0.3 * COMMANDS_HZ
    assert min(bare.late_us) > 0.0
