"""The three stages as one compiled call: for replay, batches, and a warm start."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from firmware_py.actuation.config import ActuationConfig
from firmware_py.actuation.stage import Actuation, actuate_kernel
from firmware_py.frame import LAYOUT
from firmware_py.records import Record
from firmware_py.sensing.config import SensingConfig
from firmware_py.sensing.stage import Sensing, sense_kernel
from firmware_py.tremor.config import TremorConfig
from firmware_py.tremor.stage import Tremor, estimate_kernel
from hal.compiled import kernel


@kernel
def step_all_kernel(
    frame: NDArray[np.float64],
    sense_state: Record,
    sense_params: Record,
    estimate_state: Record,
    estimate_params: Record,
    actuate_state: Record,
    actuate_params: Record,
) -> None:
    """Sense, estimate, actuate on one frame whose input columns and scan status bits are set."""
    sense_kernel(frame, sense_state, sense_params)
    estimate_kernel(frame, estimate_state, estimate_params)
    actuate_kernel(frame, actuate_state, actuate_params)


@kernel
def batch_kernel(
    frames: NDArray[np.float64],
    sense_state: Record,
    sense_params: Record,
    estimate_state: Record,
    estimate_params: Record,
    actuate_state: Record,
    actuate_params: Record,
) -> None:
    """``step_all_kernel`` over the rows of ``frames`` (n, Layout.size)."""
    for k in range(len(frames)):
        step_all_kernel(
            frames[k],
            sense_state,
            sense_params,
            estimate_state,
            estimate_params,
            actuate_state,
            actuate_params,
        )


class Chain:
    """All three stages. ``step`` for one frame, ``run`` for many; both give the same numbers bit for bit."""

    def __init__(self, sensing: Sensing, tremor: Tremor, actuation: Actuation) -> None:
        self.sensing = sensing
        self.tremor = tremor
        self.actuation = actuation

    def _arguments(self) -> tuple[Record, ...]:
        return (
            self.sensing.state,
            self.sensing.params,
            self.tremor.state,
            self.tremor.params,
            self.actuation.state,
            self.actuation.params,
        )

    def step(self, frame: NDArray[np.float64]) -> None:
        step_all_kernel(frame, *self._arguments())

    def run(self, frames: NDArray[np.float64]) -> None:
        """Rows of ``frames`` (n, Layout.size), C order, inputs filled; the other columns are written."""
        batch_kernel(frames, *self._arguments())

    def reset(self) -> None:
        self.sensing.reset()
        self.tremor.reset()
        self.actuation.reset()


def warm_up(chain: Chain) -> None:
    """Compile (or load from the cache) every kernel of ``chain`` by running it once, then reset it."""
    frame = LAYOUT.new_frame()
    chain.sensing.step(frame)
    chain.tremor.step(frame)
    chain.actuation.step(frame)
    chain.step(frame)
    chain.run(np.zeros((1, LAYOUT.size)))
    chain.reset()


def default_chain() -> Chain:
    """The instrument as configured by default."""
    return Chain(Sensing(SensingConfig()), Tremor(TremorConfig()), Actuation(ActuationConfig()))
