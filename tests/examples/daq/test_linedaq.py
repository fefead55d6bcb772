"""Its bytes by hand; then the whole instrument on this DAQ, in virtual time."""

import shutil
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

import benches
from drivers.registry import Site, find_driver
from firmware_py.app import run_in_process
from firmware_py.run_request import RunRequest
from hal.bench import DeviceSpec
from hal.clock import VirtualClock
from hal.errors import ProtocolError
from hal.types import ScanConfig


class Port:
    said, left = b"", b"0 1 -2\n1 32767 -32768\nx\n"

    def write(self, data, timeout_s):
        self.said += data

    def read_into(self, room, timeout_s):
        room[:5], self.left = self.left[:5].ljust(5), self.left[5:]
        return 5


def test_lines_are_scans():
    port, rows = Port(), np.zeros((2, 2), np.int16)
    bench = SimpleNamespace(serial=lambda bus: port, clock=VirtualClock())
    daq = find_driver("linedaq").open(Site("daq", DeviceSpec(driver="linedaq"), None, bench, None))
    daq.configure(ScanConfig(1000.0, (0, 3), (5.0, 5.0)))
    daq.start()
    assert daq.read_scans(rows, 0.0).n == 2
    assert (rows.tolist(), port.said) == ([[1, -2], [32767, -32768]], b"go 1000 0 3\n")
    with pytest.raises(ProtocolError, match="b'x' is no scan"):
        daq.read_scans(rows, 0.0)


def test_the_instrument_runs_on_it(tmp_path):
    home = Path(shutil.copytree(Path(benches.__file__).parent, tmp_path / "benches"))
    text = (home / "micron.toml").read_text().replace('"di4108"', '"linedaq"')
    (home / "micron.toml").write_text(text.replace('daq0"\n\n', 'daq0"\nbaud = 1_000_000\n\n'))
    run, _ = run_in_process(RunRequest(home / "micron.toml", 2.0, pace="virtual"))
    assert (run["devices"]["daq"], run["samples"]["lost"], run["safe_state"]["normal"]) == ("linedaq 1", 0, True)
