"""Opens the endoscope: its plan becomes sensors, and sensors become what runs in a run."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from firmware_py.endoscope.config import EndoscopeConfig, choose_steering, load_endoscope_config
from firmware_py.endoscope.frame import LAYOUT
from firmware_py.endoscope.instrument import Endoscope
from firmware_py.endoscope.targets import GameState
from firmware_py.endoscope.wiring import Sensors, inertial_devices, open_sensors
from firmware_py.run.context import Run
from firmware_py.run.safety import SafetyLimits
from firmware_py.sensing.fusion import Fusion
from hal.bench import BenchFile, OpenBench

COLUMNS = tuple(zip(LAYOUT.scalar_names(), LAYOUT.scalar_units(), strict=True))


@dataclass(frozen=True)
class EndoscopePlan:
    """``InstrumentPlan`` of the endoscope. ``on_state`` and ``until_done``: see ``Endoscope``."""

    bench: BenchFile
    config: EndoscopeConfig
    on_state: Callable[[GameState, int], None] | None = None
    until_done: bool = False

    @property
    def safety(self) -> SafetyLimits:
        return self.config.safety

    def open(self, opened: OpenBench) -> OpenedEndoscope:
        return OpenedEndoscope(self, open_sensors(opened))


@dataclass(frozen=True)
class OpenedEndoscope:
    """``OpenedInstrument`` of the endoscope. It has no outputs but the view, which nothing wears out."""

    plan: EndoscopePlan
    sensors: Sensors

    @property
    def identities(self) -> dict[str, str]:
        return self.sensors.identities

    @property
    def output(self) -> None:
        return None

    @property
    def columns(self) -> Sequence[tuple[str, str]]:
        return COLUMNS

    def metadata(self) -> dict[str, str]:
        config = self.plan.config
        rate_hz = self.sensors.by_name[choose_steering(config, self.sensors.kinds())].rate_hz
        return {"endoscope": config.model_dump_json(), "tick_hz": repr(rate_hz)}

    def assemble(self, run: Run) -> Endoscope:
        plan = self.plan
        return Endoscope(self.sensors, plan.config, run, plan.on_state, until_done=plan.until_done)


def load_endoscope(bench: BenchFile) -> EndoscopePlan:
    """Return the plan of an endoscope bench, with its filter compiled or loaded. Raises ``BenchError`` naming file and
    key."""
    config = load_endoscope_config(bench)
    choose_steering(config, dict.fromkeys(inertial_devices(bench.description), False))
    Fusion(config.fusion, 100.0).step(np.zeros(3), np.array([0.0, 0.0, 9.8]))
    return EndoscopePlan(bench, config)
