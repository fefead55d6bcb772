"""Reads every sensor whose driver is from another package once, through the bus or DAQ that the bench names."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from typing import Any

import numpy as np

from drivers.registry import Sensor, find_driver, open_device
from drivers.specs import check_devices
from firmware_py.control.wiring import Daq
from hal.bench import OpenBench
from hal.errors import BenchError, HalTimeout
from hal.types import ScanConfig

SCANS = 100


@dataclass(frozen=True)
class Value:
    """Holds a reading and the identity that the sensor reported."""

    device: str
    identity: str
    quantity: str
    value: float
    unit: str

    def as_dict(self) -> dict[str, Any]:
        return asdict(self)


def read_sensors(bench: OpenBench) -> list[Value]:
    """Probe and read all of them. ``BenchError`` when the bench has none."""
    description = bench.file.description
    options = check_devices(description, str(bench.file.path))
    inputs = _Inputs(bench, options)
    values: list[Value] = []
    for name, spec in description.device.items():
        if find_driver(spec.driver).role != "sensor":
            continue
        sensor: Sensor = open_device(bench, name, options[name], inputs.of(spec.daq or ""))
        identity = sensor.probe()
        pairs = zip(sensor.channels(), sensor.read(), strict=True)
        values += [Value(name, identity, c.name, float(v), c.unit) for c, v in pairs]
    if not values:
        raise BenchError(
            f"{bench.file.path}: no sensor of this bench has a driver from another package (docs/adding); for the "
            "instrument's own inputs use micron scope or micron imu"
        )
    return values


class _Inputs:
    """Mean volts of the inputs of the bench's DAQs; each DAQ scans once, when it is first asked."""

    def __init__(self, bench: OpenBench, options: dict[str, Any]) -> None:
        self._bench, self._options = bench, options
        self._means: dict[str, dict[int, float]] = {}

    def of(self, daq: str):
        return lambda channel: self._scanned(daq)[channel]

    def _scanned(self, name: str) -> dict[int, float]:
        if name not in self._means:
            options = self._options[name]
            daq: Daq = open_device(self._bench, name, options)
            daq.probe()
            config = ScanConfig(options.rate_hz, options.channels, (options.range_V,) * len(options.channels))
            info = daq.configure(config)
            rows, got = np.zeros((SCANS, len(info.channels)), dtype=np.int16), 0
            daq.start()
            try:
                while got < SCANS:
                    block = daq.read_scans(rows[got:], 1.0)
                    if block.n == 0:
                        raise HalTimeout("no scan within 1 s", device=name)
                    got += block.n
            finally:
                daq.stop()
            means = rows.mean(axis=0) * np.array(info.lsb_V)
            self._means[name] = dict(zip(info.channels, means.tolist(), strict=True))
        return self._means[name]
