"""A firmware for the kill tests: records rows at 1 kHz until somebody kills it.

``python producer.py PATH``: prints the recorder's process number, then how many rows were pushed, now and then.
"""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np

from firmware_py.recording.recorder import RecorderProcess
from hal.clock import MonotonicClock

if __name__ == "__main__":
    recorder = RecorderProcess.start(Path(sys.argv[1]), [("tick", "1"), ("t", "s"), ("x", "V")], {"bench": "text"})
    print(recorder.pid, flush=True)
    clock = MonotonicClock()
    start_ns = clock.now_ns()
    for k in range(60_000):
        clock.sleep_until_ns(start_ns + k * 1_000_000)
        recorder.push(np.array([float(k), k * 1e-3, k * 0.5]))
        if k == 120:
            recorder.event({"event": "early", "t_ns": 120_000_000})
        if k % 25 == 0:
            print(k + 1, flush=True)
