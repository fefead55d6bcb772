"""Offers one interface to every tremor estimator: ``step(sample) -> now, ahead, frequency, amplitude, confidence``.

A compiled step processes three axes at a time and allocates nothing. The WFLC runs under every method, because it
measures the frequency. Confidence is computed alike for all methods: 1 minus the relative size of the prediction
errors. It is 0 until the estimator has settled, and for a method that needs the WFLC's frequency while that is not
locked.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from math import exp, nan, pi, sqrt
from typing import Any, cast

import numpy as np

from firmware_py.records import Records, copy_record, new
from firmware_py.tremor.adaptive import ADAPTIVE
from firmware_py.tremor.adaptive_design import lever_signals
from firmware_py.tremor.combiner import (
    combiner_coast,
    combiner_displacement,
    combiner_params,
    combiner_state,
    combiner_step,
)
from firmware_py.tremor.config import TremorConfig
from firmware_py.tremor.family import AXES, HISTORY, ROWS, TURNS, EstimatorParams, EstimatorState, Family, Samples
from firmware_py.tremor.own import FOREIGN
from hal.arrays import Array
from hal.compiled import inlined_kernel, kernel
from hal.kernel_calls import ChosenKernel

NOW, AHEAD, FREQUENCY, AMPLITUDE, TRUST, CORE = range(6)
"""Rows of an estimator's output, each of three axes: tremor now (m), tremor ``loop_delay_s`` later (m), frequency (Hz),
amplitude (m), confidence (0 to 1), and the core of the tremor later (m), which does not yield when the stroke ends."""


@kernel
def _no_tick(coasts: bool, state: EstimatorState, params: EstimatorParams) -> None:
    pass  # the combiner runs under every method


@kernel
def _no_sample(samples: Samples, state: EstimatorState, params: EstimatorParams) -> None:
    pass


@kernel
def _combined(axis: int, state: EstimatorState, params: EstimatorParams) -> tuple[float, float, float]:
    own, numbers = state.combiner[axis], params.combiner
    ahead = combiner_displacement(own, numbers, numbers.sensor.delay_s)
    return combiner_displacement(own, numbers, 0.0), ahead, ahead


def _three(config: TremorConfig) -> Any:
    one: Any = combiner_state(config)
    return np.repeat(one, AXES)[None, :]


COMBINERS = Family(EstimatorParams, EstimatorState, combiner_params, _three, _no_tick, _no_sample, _combined)
FAMILIES: Mapping[str, Family] = {"adaptive": ADAPTIVE, "own": FOREIGN, "combiner": COMBINERS}
"""Families by the name of their record. Every estimator has the combiner's record, so this family comes last."""
FAMILY_OF: Mapping[str, str] = {"adaptive": "adaptive", "wflc_flc": "combiner", "flc": "combiner", "wflc": "combiner"}
"""Family of each built-in method; a method of another package is of the family "own"."""
_tick = ChosenKernel(FAMILIES, "tick")
_sample = ChosenKernel(FAMILIES, "sample")
_output = ChosenKernel(FAMILIES, "output")
estimator_learn = ChosenKernel(FAMILIES, "learn")


def estimator_params(config: TremorConfig) -> Records[EstimatorParams]:
    """Return the parameters of ``config.method`` and of the combiner; their field ``fresh`` is the state before the
    first sample. Raises ``BenchError`` for an estimator of another package that breaks the rules of ``OwnEstimator``.
    """
    name = FAMILY_OF.get(config.method, "own")
    family = FAMILIES[name]
    state = {n: FAMILIES[n].new_state(config) for n in ("combiner", name)}
    params: dict[str, Any] = {n: FAMILIES[n].new_params(config) for n in ("combiner", name)}
    return new(
        family.params,
        None,
        **params,
        fresh=new(family.state, last_tick=np.nan, **state),
        needs_lock=int(config.method in ("wflc", "wflc_flc")),
        delay_ticks=min(HISTORY - 1, round(config.loop_delay_s * config.tick_hz)),
        settle_ticks=config.settle_s * config.tick_hz,
        max_gap_ticks=float(config.max_gap_ticks),
        lever=lever_signals(config.lever)[:, 1:, AXES:] if config.lever else np.zeros((AXES, TURNS, AXES)),
        smoothing=1.0 - exp(-1.0 / (config.smoothing_s * config.tick_hz)),
        floor2=config.floor_m**2,
    )


def estimator_state(params: Records[EstimatorParams]) -> Records[EstimatorState]:
    """Return a copy of ``params``' state before the first sample."""
    return cast("Records[EstimatorState]", np.array(params["fresh"]))


@inlined_kernel
def estimator_ticks(state: EstimatorState, steps: int, coast: bool, param: EstimatorParams) -> None:
    """Advance by ``steps`` ticks. All but the last one coast, that is, the model runs on without a sample; the last one
    coasts if ``coast``, else ``estimator_samples`` must follow."""
    state.ticks += steps
    for n in range(steps):
        state.at = (state.at + 1) % HISTORY
        coasts = coast or n < steps - 1
        _tick(coasts, state, param)
        if coasts:
            for i in range(AXES):
                combiner_coast(state.combiner[i], param.combiner)


@inlined_kernel
def estimator_samples(state: EstimatorState, param: EstimatorParams) -> None:
    """Process the present tick's ``state.samples``, ``turned`` and ``up``, which must be finite."""
    for i in range(AXES):
        combiner_step(state.samples[i], state.combiner[i], param.combiner)
    _sample(Samples(state.samples, state.turned, state.up), state, param)


@inlined_kernel
def estimator_output(state: EstimatorState, param: EstimatorParams) -> None:
    """Fill ``state.out`` (6, 3), rows as named above, and update the confidence."""
    out = state.out
    for i in range(AXES):
        now, ahead, core = _output(i, state, param)
        ring = state.predicted[i]
        missed = now - ring[(state.at - param.delay_ticks) % HISTORY]
        ring[state.at] = ahead
        state.power[i] += param.smoothing * (now * now - state.power[i])
        state.miss[i] += param.smoothing * (missed * missed - state.miss[i])
        out[NOW, i] = now
        out[AHEAD, i] = ahead
        out[CORE, i] = core
        out[FREQUENCY, i] = state.combiner[i].wflc.omega * param.combiner.sensor.tick_hz / (2.0 * pi)
        out[AMPLITUDE, i] = sqrt(2.0 * state.power[i])
        trust = 0.0
        if state.ticks > param.settle_ticks and not (param.needs_lock and state.combiner[i].wflc.miss > 0.7):
            total = state.power[i] + param.floor2
            trust = max(0.0, 1.0 - sqrt((state.miss[i] + param.floor2) / total))
        out[TRUST, i] = trust


@kernel
def run_estimator(
    samples: Array, out: Array, states: Records[EstimatorState], params: Records[EstimatorParams]
) -> None:
    """Run the estimator over ``samples`` (n, 3), one row per tick, in m/s^2 or m, and fill ``out`` (n, 6, 3), whose
    rows are named above. If a sample is not finite on one axis, all three axes coast in that tick."""
    state, param = states[0], params[0]
    for k in range(len(samples)):
        good = True
        for i in range(AXES):
            state.samples[i] = samples[k, i]
            good = good and np.isfinite(samples[k, i])
        estimator_ticks(state, 1, not good, param)
        if good:
            estimator_samples(state, param)
        estimator_output(state, param)
        for row in range(ROWS):
            for i in range(AXES):
                out[k, row, i] = state.out[row, i]


@dataclass(frozen=True)
class Estimate:
    """Holds the estimates of k axes: arrays (k,) for one sample, (n, k) for n samples.

    ``now_m``, ``ahead_m``: tremor at the sample and ``loop_delay_s`` later. ``confidence``: 0 to 1. ``intended_m``: the
    sample minus ``now_m``, nan for an accelerometer.
    """

    now_m: Array
    ahead_m: Array
    frequency_hz: Array
    amplitude_m: Array
    confidence: Array
    intended_m: Array


class Estimator:
    """Runs one method on ``axes`` axes (1 to 3) of the tip, without a lever; the instrument's stage uses the same
    kernels. Raises ``ValueError`` for another number of axes."""

    def __init__(self, config: TremorConfig, axes: int = AXES) -> None:
        if not 1 <= axes <= AXES:
            raise ValueError(f"{axes} axes; an estimator has 1 to {AXES}")
        self.config, self.axes = config.model_copy(update={"lever": None}), axes
        self.params = estimator_params(self.config)
        self.state = estimator_state(self.params)

    def reset(self) -> None:
        """Restore the state before the first sample."""
        copy_record(self.state, estimator_state(self.params))

    def step(self, sample: Array) -> Estimate:
        """Process ``sample`` (axes,) of the next tick, in m/s^2 or m as ``config.sees`` says. If it is not finite on
        one axis, all axes coast: the model runs on, and the estimates are predictions."""
        return self._estimate(self._run(np.asarray(sample, dtype=np.float64)[None, :]), sample, 0)

    def run(self, samples: Array) -> Estimate:
        """Process ``samples`` (n, axes); the result equals that of n steps."""
        return self._estimate(self._run(samples), samples, slice(None))

    def _run(self, samples: Array) -> Array:
        whole = np.zeros((len(samples), AXES))
        whole[:, : self.axes] = samples
        out = np.empty((len(samples), ROWS, AXES))
        run_estimator(whole, out, self.state, self.params)
        return out[:, :, : self.axes]

    def _estimate(self, out: Array, samples: Array, rows: int | slice) -> Estimate:
        now = out[rows, NOW]
        path = np.asarray(samples) - now if self.config.sees == "displacement" else np.full(now.shape, nan)
        return Estimate(now, out[rows, AHEAD], out[rows, FREQUENCY], out[rows, AMPLITUDE], out[rows, TRUST], path)
