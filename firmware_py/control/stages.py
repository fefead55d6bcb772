"""The three compiled stages in the order in which a sample passes: sense, estimate, actuate.

One implementation for the live loop and for replay: whoever fills the frame's input columns gets the same
estimates and commands.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from firmware_py.actuation.config import ActuationConfig
from firmware_py.actuation.stage import Actuation
from firmware_py.control.manual import follow
from firmware_py.frame import COMMAND, LAYOUT, STATUS, FrameStatus
from firmware_py.sensing.config import SensingConfig
from firmware_py.sensing.stage import Sensing
from firmware_py.tremor.config import TremorConfig
from firmware_py.tremor.detectors import Detectors
from firmware_py.tremor.stage import Tremor
from hal.errors import BenchError

Frame = NDArray[np.float64]


@dataclass(frozen=True)
class StageConfigs:
    """Everything that the stages compute with; kept in recordings, so that a replay is the same firmware."""

    sensing: SensingConfig
    tremor: TremorConfig
    actuation: ActuationConfig

    def as_dict(self) -> dict[str, Any]:
        """Plain JSON values."""
        return {name: getattr(self, name).model_dump(mode="json") for name in ("sensing", "tremor", "actuation")}

    @classmethod
    def from_dict(cls, tables: Mapping[str, Mapping[str, Any]], where: str) -> StageConfigs:
        """From the tables of a bench or the metadata of a recording. ``BenchError`` names the wrong key."""
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
    """The stages with their state and the frame that they fill."""

    def __init__(self, configs: StageConfigs) -> None:
        self.configs = configs
        self.frame: Frame = LAYOUT.new_frame()
        self.command_V: Frame = self.frame[COMMAND : COMMAND + 3]
        self.sensing = Sensing(configs.sensing)
        self.tremor = Tremor(configs.tremor)
        self.detectors = Detectors(configs.tremor.detectors, configs.tremor.tick_hz)
        self.actuation = Actuation(configs.actuation)

    def sense(self) -> None:
        self.sensing.step(self.frame)

    def estimate(self) -> None:
        self.tremor.step(self.frame)
        self.detectors.step(self.frame)

    def actuate(self) -> None:
        """Compute the command for the newest scan and mark the frame as one that was commanded."""
        self.frame[STATUS] = int(self.frame[STATUS]) | FrameStatus.COMMANDED
        self.actuation.step(self.frame)

    def follow(self) -> None:
        """The command in the frame was chosen by hand: mark it, and let the stage's memory follow."""
        self.frame[STATUS] = int(self.frame[STATUS]) | FrameStatus.MANUAL
        follow(self.actuation, self.frame)

    def warm_up(self) -> None:
        """Compile or load every kernel, then forget what that did. A cold start takes seconds, a tick may not."""
        self.sense()
        self.estimate()
        self.actuate()
        self.follow()
        self.reset()

    def reset(self) -> None:
        """As before the first sample."""
        for stage in (self.sensing, self.tremor, self.detectors, self.actuation):
            stage.reset()
        self.frame[:] = 0.0
