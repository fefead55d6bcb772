"""Defines the one shape of all tremor estimators. ``estimator.FAMILIES`` is the table of them."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, NamedTuple

from firmware_py.records import Records, field, record
from firmware_py.tremor.combiner import CombinerParams, CombinerState
from firmware_py.tremor.config import TremorConfig
from hal.arrays import Array
from hal.compiled import kernel

AXES = 3
TURNS = 2  # signals of an axis beside the tip's acceleration
HISTORY = 64  # ticks of predictions kept for the confidence: the longest loop delay and some
ROWS = 6
"""Rows of what a step gives, each for three axes."""


@record
class EstimatorState:
    """The state that all estimators have; each adds its own record."""

    combiner: Records[CombinerState] = field("", AXES)
    predicted: Array = field("m", AXES, HISTORY)  # ring of past predictions
    at: int = field("1")
    power: Array = field("m^2", AXES)  # smoothed x^2
    miss: Array = field("m^2", AXES)  # smoothed (x - predicted)^2
    ticks: float = field("1")  # since the start
    last_tick: float = field("1")  # of the stage that reads frames
    samples: Array = field("m/s^2 or m", AXES)
    turned: Array = field("m/s^2", AXES, TURNS)  # the turns across the arm, a part of the samples, and about it
    up: Array = field("1", 3)  # body frame
    out: Array = field("m, Hz, 1", ROWS, AXES)


@record
class EstimatorParams:
    """The numbers that all estimators have; each adds its own record."""

    combiner: CombinerParams = field("")
    fresh: EstimatorState = field("")  # the state at the start
    needs_lock: int = field("1")
    delay_ticks: int = field("1")
    settle_ticks: float = field("1")
    max_gap_ticks: float = field("1")
    lever: Array = field("m", AXES, TURNS, AXES)  # from angular acceleration to an axis' further signals
    smoothing: float = field("1")
    floor2: float = field("m^2")


class Samples(NamedTuple):
    """A tick's samples of the tip (3,), m/s^2 or m; of each axis the turns across the arm and about it (3, TURNS),
    m/s^2; and up (3,), body frame."""

    tip: Array
    turned: Array
    up: Array


@kernel
def learn_nothing(_given: int, state: EstimatorState, params: EstimatorParams) -> None:
    """Stand for ``Family.learn`` of an estimator whose ticks cost the same."""


@dataclass(frozen=True)
class Family:
    """An estimator, or several that differ by numbers alone.

    ``params`` and ``state`` are the estimator's records, with one of its own that has the family's name in
    ``estimator.FAMILIES``; ``new_params(config)`` and ``new_state(config)`` make that one. The kernels take ``(input,
    state, params)``, the whole records; input and result are:

    - ``tick``: ``coasts``, true for a tick without a sample. The model runs on by one tick.
    - ``sample``: ``Samples`` of the present tick.
    - ``output``: the axis. Returns the tremor now, ahead by the loop's delay, and the core of the latter, m.
    - ``learn``: nothing, 0. Does what the next ``tick`` would begin with and what needs nothing of that tick, so that
      the next output is earlier. The numbers are the same without it.
    """

    params: type[EstimatorParams]
    state: type[EstimatorState]
    new_params: Callable[[TremorConfig], Records[Any]]
    new_state: Callable[[TremorConfig], Any]
    tick: Callable[[bool, Any, Any], None]
    sample: Callable[[Samples, Any, Any], None]
    output: Callable[[int, Any, Any], tuple[float, float, float]]
    learn: Callable[[int, Any, Any], None] = learn_nothing
