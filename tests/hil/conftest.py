"""One bench for the hardware tests: the emulated one in virtual time, or ``--bench FILE`` in real time.

A device that the bench declares and that does not answer is a failure, not a skip.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import pytest

from firmware_py.control.wiring import Devices, open_devices
from hal.bench import BenchFile, OpenBench, load_bench, open_bench
from tests.conftest import DEFAULT_BENCH


@dataclass
class Stand:
    """An opened bench with its probed devices."""

    file: BenchFile
    bench: OpenBench
    devices: Devices


@pytest.fixture(scope="session")
def bench_file(request: pytest.FixtureRequest) -> BenchFile:
    chosen = request.config.getoption("--bench")
    return load_bench(Path(chosen) if chosen else DEFAULT_BENCH)


@pytest.fixture
def virtual(request: pytest.FixtureRequest) -> bool:
    return request.config.getoption("--bench") is None


@pytest.fixture
def stand(request: pytest.FixtureRequest, bench_file: BenchFile, virtual: bool, tmp_path: Path) -> Iterator[Stand]:
    """The bench, opened and probed afresh for each test, and left in its safe state."""
    marker = request.node.get_closest_marker("needs")
    for name in marker.args if marker is not None else ():
        if name not in bench_file.description.device:
            pytest.skip(f"{bench_file.path} declares no device '{name}'")
    with open_bench(bench_file, pace="virtual" if virtual else "realtime", runtime_dir=tmp_path) as bench:
        devices = open_devices(bench)
        try:
            yield Stand(bench_file, bench, devices)
        finally:
            devices.daq.stop()
            devices.amplifier.close()
