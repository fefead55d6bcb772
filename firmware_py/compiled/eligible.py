"""Decides from the description alone if a bench can run in the compiled thread, before a device is touched."""

from __future__ import annotations

import platform
import sys

from drivers.options import Adxl203Options
from drivers.registry import find_driver
from drivers.specs import check_devices
from firmware_py.endoscope.wiring import is_endoscope
from hal.bench import BenchFile, CanSpec, Pace
from hal.errors import BenchError

IN_TICK = ("daq", "output")
"""Roles of the devices that every tick reads or writes. Others are polled by Python beside the thread."""
AXES = 6
INJECTED = "--inject is Python between the loop and a device"
"""Why a run with injected faults cannot be compiled."""


def reasons_against_bench(bench: BenchFile, pace: Pace, *, injected: bool = False) -> list[str]:
    """Return why ``bench`` cannot run compiled, each reason with its device; an empty list if it can. ``injected``:
    faults are injected on a bus."""
    if is_endoscope(bench.description):
        return ["an endoscope's loop is Python"]
    options = check_devices(bench.description, str(bench.path))
    reasons: list[str] = []
    if platform.machine() not in ("x86_64", "AMD64") or sys.platform != "linux":
        reasons.append(f"the thread needs Linux on x86-64, this is {sys.platform} on {platform.machine()}")
    for name, spec in bench.description.device.items():
        driver = find_driver(spec.driver)
        if driver.role in IN_TICK and not driver.has_kernels:
            reasons.append(f"device.{name}: its driver {spec.driver} has no kernels on bytes")
        bus = bench.description.bus.get(spec.bus or "")
        if driver.role in IN_TICK and isinstance(bus, CanSpec) and not _has_frame_socket(bus.uri):
            reasons.append(f"device.{name}: its bus {bus.uri} has no socket of single frames; socketcan:// has")
    axes = {f"device.{name}": len(o.channels) for name, o in options.items() if isinstance(o, Adxl203Options)}
    if (n_axes := sum(axes.values())) > AXES:
        why = f"{n_axes} accelerometer axes; what tells which of more than {AXES} is wrong is Python"
        reasons.append(f"{', '.join(axes)}: {why}")
    if pace != "realtime":
        reasons.append("emulated time passes in Python (--realtime runs on the wall clock)")
    if injected:
        reasons.append(INJECTED)
    return reasons


def _has_frame_socket(uri: str) -> bool:
    return uri.startswith(("socketcan://", "unix-can://", "sim://")) and not uri.endswith("?via=slcan")


SPIN_PART = 0.25
"""Longest spin before a scan, and after it, as a part of the tick: the loop then uses half of its processor at most."""


def check_spin(bench: BenchFile, spin_us: float) -> None:
    """Raise ``BenchError`` if the thread cannot wait awake for so long before and after each scan."""
    most_us = SPIN_PART * 1e6 / bench.description.clock.tick_hz
    if not 0.0 <= spin_us <= most_us:
        raise BenchError(
            f"{bench.path}: --spin-us {spin_us:g} is outside 0 .. {most_us:g} us, a quarter of a tick; other programs "
            "need the rest of the processor"
        )


def check_compiled(bench: BenchFile, pace: Pace, *, injected: bool = False) -> None:
    """Raise ``BenchError`` for a bench that cannot run compiled."""
    if reasons := reasons_against_bench(bench, pace, injected=injected):
        raise BenchError(f"{bench.path}: --compiled cannot run: {'; '.join(reasons)}; without it the loop is Python")
