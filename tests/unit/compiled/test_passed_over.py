"""Scans without a tick of their own: which of them the thread itself was too busy for, and which came in a hold."""

from __future__ import annotations

import os
import signal
import threading
import time
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from firmware_py.app import run_in_process
from firmware_py.compiled import memory as at
from firmware_py.compiled.thread import count_busy
from firmware_py.run_request import RunRequest
from hal.bench import OpenBench

SERIAL = Path(__file__).parents[3] / "benches" / "micron-e727.toml"
MS = 1_000_000


@pytest.mark.parametrize(
    ("n", "waits_since_ms", "busy"),
    [
        (1, 9.0, 0),  # the newest scan has a tick of its own
        (3, 0.0, 0),  # the thread waited all the time: the scans came together
        (3, 1.2, 0),  # scans of 1 and 2 ms arrive 0.3 ms later
        (3, 1.4, 1),
        (3, 2.4, 2),
        (3, 9.0, 2),
    ],
)
def test_a_scan_that_came_before_the_wait_began_is_counted_as_busy(n: int, waits_since_ms: float, busy: int):
    words = np.zeros(at.N_WORDS, np.int64)
    words[at.BLOCK_N], words[at.BLOCK_T0_NS], words[at.DT_NS], words[at.ARRIVAL_NS] = n, MS, MS, 300_000
    words[at.WAITS_SINCE_NS] = round(waits_since_ms * MS)
    count_busy(words)
    assert words[at.BUSY] == busy


@pytest.mark.slow
@pytest.mark.realtime
@pytest.mark.timeout(400)
def test_scans_of_a_hold_are_counted_apart(tmp_path: Path):
    """The world stands still for longer than the loop waits for a scan: it holds, and arms anew, while scans come."""
    opened_bench: list[OpenBench] = []
    stops: list[threading.Thread] = []

    def stop_world() -> None:
        world: Any = opened_bench[0].world
        os.kill(world.pid, signal.SIGSTOP)
        time.sleep(0.06)
        os.kill(world.pid, signal.SIGCONT)

    def stop_once(status: Mapping[str, Any]) -> None:
        if not stops and status["state"] == "running":
            stops.append(threading.Thread(target=stop_world))
            stops[0].start()

    request = RunRequest(SERIAL, 3.0, pace="realtime", compiled=True)
    outcome, _ = run_in_process(request, stop_once, tmp_path, opened_bench.append)
    loop = outcome["loop"]
    assert outcome["holds"]
    assert loop["passed_over_held"] > 0
    assert 0 <= loop["passed_over_busy"] <= loop["passed_over"]
    ticks = outcome["ticks"]
    assert loop["passed_over"] + loop["passed_over_held"] <= ticks["caught_up"] + ticks["skipped"]
