"""Starts the guardian of a bench's output: a process in real time, callbacks of the clock in virtual time."""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Generator
from dataclasses import dataclass
from typing import Any

from drivers.piezo.dac_output import DacOutput
from drivers.specs import device_options
from firmware_py.guardian.amplifier import GuardedAmplifier
from firmware_py.guardian.gate import LEASE_MARGIN_MS
from firmware_py.guardian.guardian import STEP_NS, Guardian, State
from firmware_py.guardian.heartbeat import Heartbeat
from firmware_py.guardian.lifecycle import GuardianLifecycle, start_error
from firmware_py.guardian.process import GuardianProcess
from firmware_py.run.safety import SafetyLimits
from hal.bench import I2cSpec, OpenBench, Processes
from hal.clock import VirtualClock
from hal.contracts import AnalogOutput

START_NS = 500_000_000
"""Time that a new guardian takes to start in virtual time, about as long as its process takes in real time."""


@dataclass(frozen=True)
class Guarded:
    """Holds the output of a run. ``lifecycle`` is that of its guardian, ``None`` without one."""

    output: AnalogOutput | None
    lifecycle: GuardianLifecycle | None = None


@contextlib.contextmanager
def guarded(
    opened: OpenBench, output: AnalogOutput | None, limits: SafetyLimits, *, may_be_killed: bool = False
) -> Generator[Guarded]:
    """Put a guardian beside ``output`` if that is a DAC, which has no watchdog of its own, and stop it at the end.

    ``may_be_killed``: the guardian may kill this process when it stands still in the middle of a command.
    Raises ``OpenFailed`` if the guardian cannot reach the output.
    """
    if not limits.guardian or not isinstance(output, DacOutput):
        yield Guarded(output)
        return
    # without scans there are no commands, and the loop's own limit for scans must act first
    lease_ms = max(limits.guardian_ms, 2.0 * limits.stale_ms)
    times: dict[str, Any] = {
        "notice_ms": limits.guardian_notice_ms,
        "limit_ms": lease_ms + LEASE_MARGIN_MS,
        "retry_s": limits.neutral_retry_s,
    }
    options, part = _options(opened, output.name), type(output)
    if isinstance(opened.clock, VirtualClock):
        clock, bus = opened.clock, _bus_of(opened, output.name)
        handle = VirtualGuardian(
            lambda heartbeat: Guardian(heartbeat, part(bus, clock, **options), clock, **times), clock, opened.processes
        )
    else:
        driver = opened.file.description.device[output.name].driver
        settings = {**_uri(opened, output.name), "driver": driver, "options": options, **times}
        handle = GuardianProcess(settings, opened.runtime_dir, may_be_killed=may_be_killed)
    try:
        if isinstance(handle, GuardianProcess):
            handle.await_ready()
        handle.heartbeat.note_guardian_alive(opened.clock.now_ns())
        leased = GuardedAmplifier(output, handle, opened.clock, lease_ms=lease_ms)
        yield Guarded(leased, GuardianLifecycle(handle))
    finally:
        handle.stop()


class VirtualGuardian:
    """Implements ``GuardianHandle`` for a guardian that steps by callbacks of a virtual clock, half a step after the
    firmware's ticks.

    Its transfers take their time on the bus as the firmware's do. ``processes.dead`` ends it like ``kill -9``.
    """

    def __init__(self, make: Callable[[Heartbeat], Guardian], clock: VirtualClock, processes: Processes) -> None:
        self.heartbeat = Heartbeat()
        self._make, self._clock, self._processes = make, clock, processes
        self._ready_ns: int | None = None
        self._guardian = self._begin()

    def is_alive(self) -> bool:
        is_watching = self._ready_ns is None and self._guardian.state is not State.DONE
        return is_watching and "guardian" not in self._processes.dead

    def kill(self) -> None:
        self._guardian.stop()

    def begin_replacement(self) -> None:
        self.kill()
        self.heartbeat.clear_guardian()
        self._ready_ns = self._clock.now_ns() + START_NS

    def finish_replacement(self) -> bool:
        if self._ready_ns is None or self._clock.now_ns() < self._ready_ns:
            return False
        if "new guardians" in self._processes.dead:
            raise start_error("a fault test killed it")
        self._ready_ns = None
        self._processes.dead.discard("guardian")
        self._guardian = self._begin()
        return True

    def stop(self, is_interrupted: Callable[[], bool] = lambda: False) -> dict[str, Any] | None:
        report = self._guardian.report()
        self.kill()
        return report

    def _begin(self) -> Guardian:
        guardian, clock, dead = self._make(self.heartbeat), self._clock, self._processes.dead
        self._processes.guardian_report = guardian.report

        def step(t_ns: int) -> None:
            if "guardian" in dead or guardian.state is State.DONE:
                return
            guardian.step(alive="firmware" not in dead)
            clock.at(t_ns + STEP_NS, step)

        clock.at(clock.now_ns() + STEP_NS // 2, step)
        return guardian


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
    options = device_options(opened.file.description, name, str(opened.file.path))
    return {"address": spec.address, "name": name, **options.model_dump()}
