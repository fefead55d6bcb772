"""Opens the first instrument: its plan becomes devices, and devices become what runs in a run."""

from __future__ import annotations

import json
from collections.abc import Callable, Sequence
from dataclasses import dataclass

from firmware_py.control.config import FirmwareConfig
from firmware_py.control.instrument import Micron
from firmware_py.control.plan import Plan
from firmware_py.control.stages import Stages
from firmware_py.control.wiring import Devices, open_devices
from firmware_py.frame import LAYOUT
from firmware_py.run.context import Run
from firmware_py.run.safety import SafetyLimits
from hal.bench import BenchFile, OpenBench
from hal.contracts import AnalogOutput

Assemble = Callable[[Devices, Stages, FirmwareConfig, Run], Micron]
COLUMNS = tuple(zip(LAYOUT.scalar_names(), LAYOUT.scalar_units(), strict=True))


@dataclass(frozen=True)
class MicronPlan:
    """``InstrumentPlan`` of the first instrument. ``make`` is what runs the ticks: ``Micron``, or a compiled one."""

    plan: Plan
    make: Assemble = Micron

    @property
    def bench(self) -> BenchFile:
        return self.plan.bench

    @property
    def safety(self) -> SafetyLimits:
        return self.plan.firmware.safety

    def open(self, opened: OpenBench) -> OpenedMicron:
        devices = open_devices(opened, self.plan.options)
        return OpenedMicron(self.plan.with_wiring(devices.sensing_table), devices, self.make)


@dataclass(frozen=True)
class OpenedMicron:
    """``OpenedInstrument`` of the first instrument."""

    plan: Plan
    devices: Devices
    make: Assemble

    @property
    def identities(self) -> dict[str, str]:
        return self.devices.identities

    @property
    def output(self) -> AnalogOutput:
        return self.devices.amplifier

    @property
    def columns(self) -> Sequence[tuple[str, str]]:
        return COLUMNS

    def metadata(self) -> dict[str, str]:
        return {"stages": json.dumps(self.plan.stages.as_dict())}

    def assemble(self, run: Run) -> Micron:
        return self.make(self.devices, Stages(self.plan.stages), self.plan.firmware, run)
