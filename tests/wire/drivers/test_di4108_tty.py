"""DI-4108 driver behind a real tty: what a kernel makes of a backlog, which no script of reads can know."""

from __future__ import annotations

import os
import threading
import time

import numpy as np
import pytest

from drivers.daq.di4108 import Di4108
from hal.backends.pyserial_port import PyserialPort
from hal.clock import MonotonicClock
from hal.types import ScanConfig

BACKLOG, AFTER = 3000, 100
pytestmark = [pytest.mark.realtime, pytest.mark.timeout(60)]


def scans(first: int, n: int) -> bytes:
    return np.repeat(np.arange(first, first + n, dtype="<i2"), 8).tobytes()


def device(master: int, piece: int) -> None:
    """Echoes commands; from ``start`` on a backlog in writes of ``piece`` bytes, then a scan every millisecond."""
    line = b""
    while not line.endswith(b"start 0\r"):
        heard = os.read(master, 1)
        line += heard
        if heard == b"\r" and not line.endswith(b"start 0\r"):
            os.write(master, line)
            line = b""
    stream = scans(0, BACKLOG)
    for i in range(0, len(stream), piece):
        part = stream[i : i + piece]
        while part:
            part = part[os.write(master, part) :]
    for k in range(BACKLOG, BACKLOG + AFTER):
        time.sleep(0.001)
        os.write(master, scans(k, 1))


@pytest.mark.parametrize("piece", [16, 1000, 4093, 65_536])
def test_a_backlog_of_seconds_loses_and_shifts_nothing(piece: int):
    master, slave = os.openpty()
    port = PyserialPort(os.ttyname(slave))
    writer = threading.Thread(target=device, args=(master, piece), daemon=True)
    try:
        writer.start()
        daq = Di4108(port, MonotonicClock())
        daq.configure(ScanConfig(1000.0, tuple(range(8)), (5.0,) * 8))
        daq.start()
        out, found = np.zeros((1024, 8), dtype=np.int16), list[int]()
        ends_s = time.monotonic() + 20.0
        while len(found) < BACKLOG + AFTER and time.monotonic() < ends_s:
            n = daq.read_scans(out, 0.05).n
            assert (out[:n] == out[:n, :1]).all()
            found += out[:n, 0].tolist()
        assert found == list(range(BACKLOG + AFTER))
    finally:
        writer.join(timeout=10.0)
        port.close()
        os.close(slave)
        os.close(master)
