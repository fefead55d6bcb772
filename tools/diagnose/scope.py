"""The analog inputs as lines of blocks in a terminal; the outputs stay where they are, nothing is armed."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from firmware_py.control.wiring import open_devices
from hal.arrays import Array
from hal.bench import OpenBench
from tools.diagnose.extremes import extremes

BLOCKS = "▁▂▃▄▅▆▇█"
MAX_SCANS = 1024
STEP_S = 0.1


@dataclass(frozen=True)
class ChannelLine:
    """Holds one channel of the whole measurement, in V."""

    name: str
    low_V: float
    mean_V: float
    high_V: float
    rms_V: float


def sparkline(values: Array, width: int) -> str:
    """``values`` (n,) as ``width`` blocks; each shows the value of its part that is farthest from the mean, so that
    a spike is never averaged away."""
    if len(values) == 0:
        return ""
    k = max(1, -(-len(values) // width))
    data = values.astype(np.float32)[None]
    low, high = (part[0] for part in extremes(data, data, k))
    middle = float(np.mean(values))
    furthest = np.where(np.abs(high - middle) >= np.abs(low - middle), high, low)
    bottom, top = float(values.min()), float(values.max())
    if top - bottom <= 0.0:
        return BLOCKS[3] * len(furthest)
    steps = np.clip(((furthest - bottom) / (top - bottom) * len(BLOCKS)).astype(int), 0, len(BLOCKS) - 1)
    return "".join(BLOCKS[i] for i in steps)


@dataclass(frozen=True)
class Look:
    """Holds the measurement: volts (channels, n), names, lost scans."""

    names: tuple[str, ...]
    volts: Array
    rate_hz: float
    lost: int

    def lines(self) -> list[ChannelLine]:
        return [
            ChannelLine(name, float(v.min()), float(v.mean()), float(v.max()), float(v.std()))
            for name, v in zip(self.names, self.volts, strict=True)
        ]


def look(bench: OpenBench, seconds: float, show: Callable[[Look], None] = lambda _: None) -> Look:
    """Scan for ``seconds``; ``show`` gets everything so far, a few times a second."""
    devices = open_devices(bench)
    scan = devices.scan
    names = tuple(f"input {channel}" for channel in scan.channels)
    lsb_V = np.array(scan.lsb_V)
    rows = np.zeros((MAX_SCANS, len(names)), dtype=np.int16)
    parts: list[Array] = []
    wanted, got, lost, n_drawn = round(seconds * scan.rate_hz), 0, 0, 0

    def so_far() -> Look:
        volts = np.concatenate(parts, axis=0).T if parts else np.zeros((len(names), 0))
        return Look(names, volts[:, :wanted], scan.rate_hz, lost)

    devices.daq.start()
    try:
        while got < wanted:
            block = devices.daq.read_scans(rows, 0.5)
            lost += block.lost
            parts.append(rows[: block.n].astype(np.float64) * lsb_V)
            got += block.n
            if got - n_drawn >= STEP_S * scan.rate_hz:
                n_drawn = got
                show(so_far())
    finally:
        devices.daq.stop()
    return so_far()
