"""Offers one interface to every tremor estimator: ``step(sample) -> now, ahead, frequency, amplitude, confidence``.

A compiled step processes three axes at a time and allocates nothing. The WFLC runs under every method: it measures the
frequency. Confidence is the same for all: 1 minus the relative size of what earlier predictions missed; a method that
lives on the WFLC's frequency has none while the WFLC is not locked.
"""

from __future__ import annotations

from dataclasses import dataclass
from math import exp, nan, pi, sqrt

import numpy as np
from numpy.typing import NDArray

from firmware_py.records import Record, copy_record, new_record
from firmware_py.tremor.adaptive import (
    adaptive_correct,
    adaptive_dtype,
    adaptive_output,
    adaptive_params,
    adaptive_predict,
    adaptive_state,
    adaptive_state_dtype,
)
from firmware_py.tremor.adaptive_design import AdaptiveDesign, design_adaptive, lever_signals
from firmware_py.tremor.ar_kalman import (
    AR,
    ar_coast,
    ar_correct,
    ar_output,
    ar_params,
    ar_state,
    ar_state_dtype,
)
from firmware_py.tremor.bmflc import (
    bmflc_correct,
    bmflc_output,
    bmflc_params,
    bmflc_predict,
    bmflc_state,
    bmflc_state_dtype,
    comb_size,
)
from firmware_py.tremor.combiner import (
    COMBINER,
    COMBINER_STATE,
    combiner_coast,
    combiner_displacement,
    combiner_params,
    combiner_state,
    combiner_step,
)
from firmware_py.tremor.config import TremorConfig
from firmware_py.tremor.oscillator_kalman import (
    ORDER,
    combine,
    kalman_correct,
    kalman_dtype,
    kalman_params,
    kalman_predict,
)
from firmware_py.tremor.own import OWN, OWN_STATE, own_params, own_step
from hal.compiled import kernel

Array = NDArray[np.float64]
AXES = 3
HISTORY = 64  # ticks of predictions kept for the confidence: the longest loop delay and some
ADAPTIVE, KALMAN, COMBINERS, COMB, AUTOREGRESSIVE, FOREIGN = range(6)
FAMILY = {
    "adaptive": ADAPTIVE,
    "kalman": KALMAN,
    "wflc_flc": COMBINERS,
    "flc": COMBINERS,
    "wflc": COMBINERS,
    "bmflc": COMB,
    "ebmflc": COMB,
    "bmflc_kalman": COMB,
    "ar_kalman": AUTOREGRESSIVE,
}
NOW, AHEAD, FREQUENCY, AMPLITUDE, TRUST, CORE = range(6)
TURNS = 2  # signals of an axis beside the tip's acceleration
ROWS = 6
"""Rows of what a step gives, each for three axes."""


def estimator_params(config: TremorConfig) -> Record:
    """Return the parameters of all methods; ``config.method`` selects the one that answers. ``fresh`` is the state at
    the start."""
    design = design_adaptive(config)
    comb = bmflc_params(config)
    fresh = _fresh_state(config, design)
    dtype = np.dtype(
        [
            ("adaptive", adaptive_dtype(design)),
            ("kalman", kalman_dtype(len(config.kalman.frequencies_hz))),
            ("combiner", COMBINER),
            ("comb", comb.dtype),
            ("ar", AR),
            ("own", OWN),
            ("fresh", fresh.dtype),
            ("family", "i8"),
            ("needs_lock", "i8"),
            ("delay_ticks", "i8"),
            ("settle_ticks", "f8"),
            ("max_gap_ticks", "f8"),
            ("lever", "f8", (AXES, TURNS, AXES)),  # m, from angular acceleration to an axis' further signals
            ("smoothing", "f8"),
            ("floor2", "f8"),  # m^2
        ]
    )
    chosen = {"kalman": kalman_params(config)} if config.method == "kalman" else {}
    return new_record(
        dtype,
        **chosen,
        adaptive=adaptive_params(config, design),
        combiner=combiner_params(config),
        comb=comb,
        ar=ar_params(config),
        own=own_params(config),
        fresh=fresh,
        family=FAMILY.get(config.method, FOREIGN),
        needs_lock=int(config.method in ("wflc", "wflc_flc")),
        delay_ticks=min(HISTORY - 1, round(config.loop_delay_s * config.tick_hz)),
        settle_ticks=config.settle_s * config.tick_hz,
        max_gap_ticks=float(config.max_gap_ticks),
        lever=lever_signals(config.lever)[:, 1:, AXES:] if config.lever else np.zeros((AXES, TURNS, AXES)),
        smoothing=1.0 - exp(-1.0 / (config.smoothing_s * config.tick_hz)),
        floor2=config.floor_m**2,
    )


def _fresh_state(config: TremorConfig, design: AdaptiveDesign) -> Record:
    dtype = np.dtype(
        [
            ("adaptive", adaptive_state_dtype(design)),
            ("kalman", "f8", (AXES, ORDER * len(config.kalman.frequencies_hz) + 2)),
            ("combiner", COMBINER_STATE, (AXES,)),
            ("comb", bmflc_state_dtype(comb_size(config))),
            ("ar", ar_state_dtype(config)),
            ("own", OWN_STATE),
            ("predicted", "f8", (AXES, HISTORY)),  # ring of past predictions
            ("at", "i8"),
            ("power", "f8", (AXES,)),  # smoothed x^2
            ("miss", "f8", (AXES,)),  # smoothed (x - predicted)^2
            ("ticks", "f8"),  # since the start
            ("last_tick", "f8"),  # of the stage that reads frames
            ("samples", "f8", (AXES,)),
            ("turned", "f8", (AXES, TURNS)),  # the turns across the arm, a part of the samples, and about it
            ("out", "f8", (ROWS, AXES)),
        ]
    )
    return new_record(
        dtype,
        adaptive=adaptive_state(design),
        combiner=combiner_state(config),
        comb=bmflc_state(config),
        ar=ar_state(config),
        last_tick=np.nan,
    )


def estimator_state(params: Record) -> Record:
    """Return the state before the first sample."""
    return np.array(params["fresh"])


@kernel
def _foreign(state: Record, i: int, have: bool, param: Record) -> None:
    """Run one tick of an estimator from another package."""
    memory, numbers, out = state.own.memory[i], param.own.numbers, state.own.out[i]
    own_step(param.own.address, memory.ctypes.data, numbers.ctypes.data, state.samples[i], int(have), out.ctypes.data)


@kernel
def estimator_ticks(state: Record, steps: int, coast: bool, param: Record) -> None:
    """``steps`` ticks of time; the last one has a sample to come unless ``coast``."""
    state.ticks += steps
    for n in range(steps):
        state.at = (state.at + 1) % HISTORY
        if param.family == ADAPTIVE:
            adaptive_predict(state.adaptive, param.adaptive)
        elif param.family == COMB:
            bmflc_predict(state.comb, param.comb)
        elif param.family == AUTOREGRESSIVE:
            ar_coast(state.ar)
        for i in range(AXES):
            if param.family == KALMAN:
                kalman_predict(state.kalman[i], param.kalman)
            elif param.family == FOREIGN and (coast or n < steps - 1):
                _foreign(state, i, False, param)
            if coast or n < steps - 1:
                combiner_coast(state.combiner[i], param.combiner)


@kernel
def estimator_samples(state: Record, param: Record) -> None:
    """Process the present tick's ``state.samples``."""
    for i in range(AXES):
        sample = state.samples[i]
        combiner_step(sample, state.combiner[i], param.combiner)
        if param.family == ADAPTIVE:
            adaptive_correct(state.adaptive, i, sample, state.turned[i], param.adaptive)
        elif param.family == KALMAN:
            kalman_correct(state.kalman[i], sample, param.kalman)
        elif param.family == AUTOREGRESSIVE:
            ar_correct(state.ar, i, sample, param.ar)
        elif param.family == FOREIGN:
            _foreign(state, i, True, param)
    if param.family == COMB:
        bmflc_correct(state.comb, state.samples, param.comb)


@kernel
def estimator_output(state: Record, param: Record) -> None:
    """Fill ``state.out``."""
    out = state.out
    combiner = param.combiner
    for i in range(AXES):
        if param.family == ADAPTIVE:
            now = adaptive_output(state.adaptive, i, 0)
            ahead = adaptive_output(state.adaptive, i, 1)
        elif param.family == KALMAN:
            now = combine(state.kalman[i], param.kalman.now)
            ahead = combine(state.kalman[i], param.kalman.ahead)
        elif param.family == COMB:
            now = bmflc_output(state.comb, i, 0)
            ahead = bmflc_output(state.comb, i, 1)
        elif param.family == AUTOREGRESSIVE:
            now = ar_output(state.ar, i, 0, param.ar)
            ahead = ar_output(state.ar, i, 1, param.ar)
        elif param.family == FOREIGN:
            now = state.own.out[i, 0]
            ahead = state.own.out[i, 1]
        else:
            now = combiner_displacement(state.combiner[i], combiner, 0.0)
            ahead = combiner_displacement(state.combiner[i], combiner, combiner.seen.delay_s)
        ring = state.predicted[i]
        missed = now - ring[(state.at - param.delay_ticks) % HISTORY]
        ring[state.at] = ahead
        state.power[i] += param.smoothing * (now * now - state.power[i])
        state.miss[i] += param.smoothing * (missed * missed - state.miss[i])
        out[NOW, i] = now
        out[AHEAD, i] = ahead
        # the other methods know no band but the tremor's
        out[CORE, i] = adaptive_output(state.adaptive, i, 2) if param.family == ADAPTIVE else ahead
        out[FREQUENCY, i] = state.combiner[i].wflc.omega * combiner.seen.tick_hz / (2.0 * pi)
        out[AMPLITUDE, i] = sqrt(2.0 * state.power[i])
        trust = 0.0
        if state.ticks > param.settle_ticks and not (param.needs_lock and state.combiner[i].wflc.miss > 0.7):
            total = state.power[i] + param.floor2
            trust = max(0.0, 1.0 - sqrt((state.miss[i] + param.floor2) / total))
        out[TRUST, i] = trust


@kernel
def run_estimator(samples: Array, out: Array, states: Record, params: Record) -> None:
    """``samples`` (n, 3), one a tick, into ``out`` (n, 6, 3). A sample that is not finite is coasted over."""
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
        out[k, :, :] = state.out


@dataclass(frozen=True)
class Estimate:
    """Arrays (k,) for one sample, (n, k) for many; ``intended_m`` is nan for an accelerometer.

    ``now_m``, ``ahead_m``: tremor at the sample and ``loop_delay_s`` later. ``intended_m`` = sample - now_m.
    """

    now_m: Array
    ahead_m: Array
    frequency_hz: Array
    amplitude_m: Array
    confidence: Array
    intended_m: Array


class Estimator:
    """Any method on its own, one to three axes of the tip alone; the instrument's stage uses the same kernels."""

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
        """``sample`` (axes,) of the next tick, m/s^2 or m as configured; not finite: the model runs on."""
        return self._estimate(self._run(np.asarray(sample, dtype=np.float64)[None, :]), sample, 0)

    def run(self, samples: Array) -> Estimate:
        """``samples`` (n, axes): the same numbers as n steps."""
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
