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
TURNS = 2
"""Number of an axis' signals beside the tip's acceleration: the turn across the arm and the turn about it."""
HISTORY = 64
"""Number of ticks whose predictions are kept for the confidence. It exceeds the longest loop delay."""
ROWS = 6
"""Number of rows of a step's output, each of three axes; ``estimator.NOW`` and those after it name them."""


@record
class EstimatorState:
    """Holds the state that all estimators have; each adds its own record.

    In all records of estimators the unit "sample" is that of the samples: m/s^2, or m for a displacement sensor
    (``TremorConfig.sees``). The first index of an array with ``AXES`` is the axis x, y, z of the body frame.
    """

    combiner: Records[CombinerState] = field("", AXES)
    predicted: Array = field("m", AXES, HISTORY)  # ring of past predictions
    at: int = field("1")  # place in ``predicted`` of the present tick
    power: Array = field("m^2", AXES)  # smoothed x^2
    miss: Array = field("m^2", AXES)  # smoothed (x - predicted)^2
    ticks: float = field("1")  # since the start
    last_tick: float = field("1")  # of the stage that reads frames
    samples: Array = field("m/s^2 or m", AXES)
    turned: Array = field("m/s^2", AXES, TURNS)  # turn across the arm (a part of the samples), turn about the arm
    up: Array = field("1", 3)  # unit vector against gravity, body frame
    out: Array = field("m, Hz, 1", ROWS, AXES)  # rows: ``estimator.NOW`` and those after it


@record
class EstimatorParams:
    """Holds the parameters that all estimators have; each adds its own record. A run does not change them."""

    combiner: CombinerParams = field("")
    fresh: EstimatorState = field("")  # the state at the start
    needs_lock: int = field("1")  # 1: no confidence while the WFLC is not locked
    delay_ticks: int = field("1")  # the loop's delay
    settle_ticks: float = field("1")  # ticks after a start without confidence
    max_gap_ticks: float = field("1")  # a longer gap restarts the estimator
    lever: Array = field("m", AXES, TURNS, AXES)  # from angular acceleration to an axis' further signals
    smoothing: float = field("1")  # gain per tick of ``power`` and ``miss``
    floor2: float = field("m^2")  # added to ``power`` and ``miss``: noise has no confidence


class Samples(NamedTuple):
    """Holds the samples of a tick: ``tip`` (3,), m/s^2 or m; ``turned`` (3, TURNS), m/s^2, each axis' turns across the
    arm and about it; ``up`` (3,), unit vector against gravity. All are in the body frame."""

    tip: Array
    turned: Array
    up: Array


@kernel
def learn_nothing(_given: int, state: EstimatorState, params: EstimatorParams) -> None:
    """Stand for ``Family.learn`` of an estimator whose ticks cost the same."""


@dataclass(frozen=True)
class Family:
    """Describes an estimator, or several that differ only in their parameters.

    ``params`` and ``state`` are the estimator's records, with one of its own that has the family's name in
    ``estimator.FAMILIES``; ``new_params(config)`` and ``new_state(config)`` make that one. The kernels take ``(input,
    state, params)``, the whole records; input and result are:

    - ``tick``: ``coasts``, True for a tick without a sample. Advances the model by one tick, for all axes.
    - ``sample``: ``Samples`` of the present tick, all finite.
    - ``output``: the axis. Returns three values in m: the tremor now, the tremor a loop delay later, and the core of
      the latter.
    - ``learn``: 0, which is not used. Does the work of the next ``tick`` that needs none of its data, so that the next
      output is earlier. The results are the same without it.
    """

    params: type[EstimatorParams]
    state: type[EstimatorState]
    new_params: Callable[[TremorConfig], Records[Any]]
    new_state: Callable[[TremorConfig], Any]
    tick: Callable[[bool, Any, Any], None]
    sample: Callable[[Samples, Any, Any], None]
    output: Callable[[int, Any, Any], tuple[float, float, float]]
    learn: Callable[[int, Any, Any], None] = learn_nothing
