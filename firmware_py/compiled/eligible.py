"""Which benches can run in the compiled thread, from their description alone: before a device is touched."""

from __future__ import annotations

import platform
import sys

from drivers.specs import device_options
from firmware_py.endoscope.wiring import is_endoscope
from hal.bench import BenchFile, Pace
from hal.errors import BenchError

WITH_KERNELS = ("di4108", "e727")
"""Drivers of the DAQ and of the output whose bytes have kernels."""
IN_TICK = ("di4108", "nidaqmx", "dac_amplifier", "e727", "can_amplifier", "nidaqmx_ao")
"""Drivers of devices that every tick reads or writes. All others are polled by Python beside the thread."""
AXES = 6


def reasons_against_bench(bench: BenchFile, pace: Pace, injected: bool = False) -> list[str]:
    """Return why ``bench`` cannot run compiled, device by device; an empty list if it can. ``injected``: faults are
    injected, by middleware in Python."""
    description = bench.description
    if is_endoscope(description):
        return ["an endoscope bench has a loop of its own, in Python"]
    reasons: list[str] = []
    if platform.machine() not in ("x86_64", "AMD64") or sys.platform != "linux":
        reasons.append(f"the thread needs Linux on x86-64, this is {sys.platform} on {platform.machine()}")
    for name, spec in description.device.items():
        options = device_options(description, name, str(bench.path))
        in_tick = spec.driver in IN_TICK or spec.driver == "added"
        if in_tick and spec.driver not in WITH_KERNELS:
            reasons.append(f"device.{name}: driver {spec.driver} has no kernels, only {' and '.join(WITH_KERNELS)} have")
        del options
    if sum(len(spec.model_extra or {}) for spec in ()):
        reasons.append("")
    if pace != "realtime":
        reasons.append("emulated time passes in Python; --realtime runs on the wall clock")
    if injected:
        reasons.append("--inject puts Python between loop and device")
    return reasons


def check_compiled(bench: BenchFile, pace: Pace, injected: bool = False) -> None:
    """Raise ``BenchError`` for a bench that cannot run compiled."""
    if reasons := reasons_against_bench(bench, pace, injected):
        raise BenchError(f"{bench.path}: --compiled: {'; '.join(reasons)}. Without it the loop runs in Python")
