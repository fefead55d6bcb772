"""Holds the stages with their parameters and state, and the compiled call that runs them (``control.chain``).

The live loop and replay use this one implementation: whoever fills the frame's input columns gets the same
estimates and commands.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from firmware_py.actuation.config import ActuationConfig
from firmware_py.actuation.stage import Actuation
from firmware_py.control.chain import COMMANDED, HELD, MANUAL, PARTS, bind, memory_dtype, run_kernel, step_kernel
from firmware_py.frame import COMMAND, LAYOUT, STATUS
from firmware_py.records import Record
from firmware_py.sensing.config import SensingConfig
from firmware_py.sensing.stage import Sensing
from firmware_py.tremor.config import TremorConfig
from firmware_py.tremor.detectors import Detectors
from firmware_py.tremor.stage import Tremor
from hal.errors import BenchError

Frame = NDArray[np.float64]


@dataclass(frozen=True)
class StageConfigs:
    """Holds everything that the stages compute with. Recordings keep it, so that a replay runs the same firmware."""

    sensing: SensingConfig
    tremor: TremorConfig
    actuation: ActuationConfig

    def as_dict(self) -> dict[str, Any]:
        """Return the configurations as plain JSON values."""
        return {name: getattr(self, name).model_dump(mode="json") for name in ("sensing", "tremor", "actuation")}

    @classmethod
    def from_dict(cls, tables: Mapping[str, Mapping[str, Any]], where: str) -> StageConfigs:
        """Build from the tables of a bench or the metadata of a recording. Raises ``BenchError`` naming the wrong
        key."""
        tremor = TremorConfig.from_dict(tables.get("tremor", {}), where=f"{where}: firmware.tremor")
        actuation = ActuationConfig.from_dict(tables.get("actuation", {}), where=f"{where}: firmware.actuation")
        if tremor.loop_delay_s < actuation.preview_s:
            raise BenchError(
                f"{where}: firmware.tremor: loop_delay_s = {tremor.loop_delay_s:g} predicts less far ahead than the "
                f"stacks' feedforward needs (actuation preview_s = {actuation.preview_s:g}): add the time from sample "
                "to command to it"
            )
        return cls(
            SensingConfig.from_dict(tables.get("sensing", {}), where=f"{where}: firmware.sensing"), tremor, actuation
        )


class Stages:
    """Holds the stages with their state and the frame that they fill."""

    def __init__(self, configs: StageConfigs) -> None:
        self.configs = configs
        self.sensing = Sensing(configs.sensing)
        self.tremor = Tremor(configs.tremor)
        self.detectors = Detectors(configs.tremor.detectors, configs.tremor.tick_hz)
        self.actuation = Actuation(configs.actuation)
        self._memory = self._gathered()
        self._is_bound = False
        self.frame: Frame = self._memory["frame"][0]
        self.command_V: Frame = self.frame[COMMAND : COMMAND + 3]

    def _stages(self) -> tuple[Sensing, Tremor, Detectors, Actuation]:
        return self.sensing, self.tremor, self.detectors, self.actuation

    def _gathered(self) -> Record:
        """Return one record and make each stage's state and parameters views of it."""
        stages = self._stages()
        memory = np.zeros(1, memory_dtype([(stage.state.dtype, stage.params.dtype) for stage in stages]))
        for name, stage in zip(PARTS, stages, strict=True):
            for part in ("state", "params"):
                place = memory[f"{name}_{part}"][0]
                place[:] = getattr(stage, part)
                setattr(stage, part, place)
        return memory

    @property
    def memory(self) -> Record:
        """Return the frame and all that the stages know in one record (``chain.memory_dtype``), which is never moved.
        The first call compiles or loads the stages' kernels."""
        if not self._is_bound:
            bind(self._memory)
            self._is_bound = True
        return self._memory

    @property
    def arguments(self) -> tuple[Record, ...]:
        """Return state and parameters of every stage, in the order of ``chain.PARTS``."""
        return tuple(part for stage in self._stages() for part in (stage.state, stage.params))

    def step(self) -> None:
        """Run one tick on ``frame``, whose input columns and ``GIVEN_BITS`` of the status are set."""
        step_kernel(self._memory if self._is_bound else self.memory)

    def run(self, rows: Frame) -> None:
        """Run the ticks ``rows`` (n, Layout.size), C order, in place. The numbers are those of n steps; the state
        carries on."""
        run_kernel(rows, self.memory)

    def command(self) -> None:
        """Make the tick's step compute a command, because this is the newest scan and the outputs may move."""
        self.frame[STATUS] = int(self.frame[STATUS]) | COMMANDED

    def follow(self, command_V: Frame) -> None:
        """Make the tick's step follow ``command_V`` (3,), chosen by hand."""
        self.command_V[:] = command_V
        self.frame[STATUS] = int(self.frame[STATUS]) | MANUAL

    def hold(self, commanded_V: Sequence[float]) -> None:
        """Make the tick's step follow ``commanded_V`` (3,), the outputs of a hold on the way to neutral and at
        neutral."""
        self.command_V[:] = commanded_V
        self.frame[STATUS] = int(self.frame[STATUS]) | HELD

    def warm_up(self, *, batch: bool = False) -> None:
        """Compile or load the kernels of ``step``, then reset the state. A cold start takes half a minute, which a tick
        may not. ``batch`` includes the kernels of ``run``, which only replay needs."""
        self.step()
        if batch:
            self.run(np.zeros((1, LAYOUT.size)))
        self.reset()

    def warm_up_parts(self, *parts: str) -> None:
        """Compile some of ``chain.PARTS``, apart from the step: two processes share the work."""
        for name, stage in zip(PARTS, self._stages(), strict=True):
            if name in parts:
                stage.step(self.frame)
        self.reset()

    def reset(self) -> None:
        """Restore the state before the first sample."""
        for stage in self._stages():
            stage.reset()
        self.frame[:] = 0.0
