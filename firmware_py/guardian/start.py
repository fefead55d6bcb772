"""Which bench gets a guardian, and how: a process in real time, callbacks of the clock in virtual time."""

from __future__ import annotations

import contextlib
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from drivers.piezo.dac_amplifier import DacAmplifier
from drivers.specs import DacAmplifierOptions, device_options
from firmware_py.control.safety import SafetyLimits
from firmware_py.control.wiring import Devices
from firmware_py.guardian.amplifier import GuardedAmplifier
from firmware_py.guardian.gate import LEASE_MARGIN_MS
from firmware_py.guardian.guardian import STEP_NS, Guardian, State
from firmware_py.guardian.heart import Heart
from firmware_py.guardian.process import GuardianProcess
from hal.bench import I2cSpec, OpenBench, Processes
from hal.clock import VirtualClock


@contextlib.contextmanager
def guarded(
    opened: OpenBench, devices: Devices, limits: SafetyLimits, runtime_dir: Path, *, may_end_us: bool = False
) -> Iterator[Heart | None]:
    """Puts a guardian beside ``devices.amplifier`` where that is a DAC without a watchdog; yields its heartbeat.

    ``may_end_us``: it may kill this process when that stands still in the middle of a command.
    Raises ``OpenFailed`` when it has no way to the amplifier.
    """
    amplifier = devices.amplifier
    if not limits.guardian or not isinstance(amplifier, DacAmplifier):
        yield None
        return
    # without scans there are no commands: the loop's own limit for those comes first
    lease_ms = max(limits.guardian_ms, 2.0 * limits.stale_ms)
    limit_ms, notice_ms = lease_ms + LEASE_MARGIN_MS, limits.guardian_notice_ms
    options = _options(opened, amplifier.name)
    if isinstance(opened.clock, VirtualClock):
        heart = Heart()
        own = DacAmplifier(_bus_of(opened, amplifier.name), opened.clock, **options)
        guardian = Guardian(heart, own, opened.clock, notice_ms=notice_ms, limit_ms=limit_ms)
        opened.processes.guardian_report = guardian.report
        _step_in_virtual_time(guardian, opened.clock, opened.processes)
        process, evict = None, guardian.retire
    else:
        order = {**_uri(opened, amplifier.name), "options": options, "notice_ms": notice_ms, "limit_ms": limit_ms}
        process = GuardianProcess.start(order, runtime_dir, may_end_us=may_end_us)
        heart, evict = process.heart, process.evict
    try:
        if process is not None:
            process.await_ready()
        heart.watch(opened.clock.now_ns())
        devices.guardian = heart
        devices.amplifier = GuardedAmplifier(amplifier, heart, opened.clock, lease_ms=lease_ms, evict=evict)
        yield heart
    finally:
        evict() if process is None else process.stop()


def _step_in_virtual_time(guardian: Guardian, clock: VirtualClock, processes: Processes) -> None:
    """Half a step beside the firmware's ticks; its transfers take their time on the bus as the firmware's do."""

    def step(t_ns: int) -> None:
        if "guardian" in processes.dead:
            return
        guardian.step(alive="firmware" not in processes.dead)
        if guardian.state is not State.DONE:
            clock.at(t_ns + STEP_NS, step)

    clock.at(clock.now_ns() + STEP_NS // 2, step)


def _bus_of(opened: OpenBench, name: str) -> Any:
    return opened.i2c(opened.file.description.device[name].bus or "")


def _uri(opened: OpenBench, name: str) -> dict[str, Any]:
    bus = opened.file.description.device[name].bus or ""
    spec = opened.file.description.bus[bus]
    assert isinstance(spec, I2cSpec)
    emulated = opened.world is not None and bus in opened.file.description.emulated_buses()
    uri = opened.world.endpoint(bus) if emulated and opened.world is not None else spec.uri
    return {"uri": uri, "speed_hz": spec.speed_hz}


def _options(opened: OpenBench, name: str) -> dict[str, Any]:
    spec = opened.file.description.device[name]
    options: DacAmplifierOptions = device_options(opened.file.description, name, str(opened.file.path))
    return {"address": spec.address or 0x0C, "name": name, **options.model_dump()}
