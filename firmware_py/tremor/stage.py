"""The tremor stage: acceleration of the tip -> tremor now, tremor over the loop's delay, frequency, confidence."""

from __future__ import annotations

from math import exp, pi, sqrt
from typing import Any

import numpy as np
from numpy.typing import NDArray

from firmware_py.frame import (
    ALIGNING,
    CONFIDENCE,
    INVALID,
    RESTARTED,
    SETTLING,
    STALE,
    STATUS,
    TICK,
    TIP_ACCELERATION,
    TREMOR,
    TREMOR_AHEAD,
    TREMOR_AMPLITUDE,
    TREMOR_FREQUENCY,
)
from firmware_py.records import Record, attributes, copy_record, new_record
from firmware_py.tremor.combiner import (
    COMBINER,
    COMBINER_STATE,
    combiner_coast,
    combiner_displacement,
    combiner_params,
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
from firmware_py.tremor.wflc import wflc_restart
from hal.compiled import kernel

HISTORY = 64  # ticks of predictions kept for the confidence: the longest loop delay and some


def estimate_dtype(n_modes: int) -> np.dtype[Any]:
    return np.dtype(
        [
            ("kalman", kalman_dtype(n_modes)),
            ("combiner", COMBINER),
            ("use_kalman", "i8"),
            ("delay_ticks", "i8"),
            ("settle_ticks", "f8"),
            ("smoothing", "f8"),
            ("floor2", "f8"),  # m^2
            ("max_gap_ticks", "f8"),
        ]
    )


def estimate_state_dtype(n_modes: int) -> np.dtype[Any]:
    return np.dtype(
        [
            ("kalman", "f8", (3, ORDER * n_modes + 2)),
            ("combiner", COMBINER_STATE, (3,)),
            ("predicted", "f8", (3, HISTORY)),  # ring of past predictions
            ("at", "i8"),
            ("power", "f8", (3,)),  # smoothed x^2
            ("miss", "f8", (3,)),  # smoothed (x - predicted)^2
            ("ticks", "f8"),  # since the start
            ("last_tick", "f8"),
        ]
    )


def estimate_params(config: TremorConfig) -> Record:
    """All numbers of the stage."""
    return new_record(
        estimate_dtype(len(config.kalman.frequencies_hz)),
        kalman=kalman_params(config),
        combiner=combiner_params(config),
        use_kalman=int(config.method == "kalman"),
        delay_ticks=min(HISTORY - 1, round(config.loop_delay_s * config.tick_hz)),
        settle_ticks=config.settle_s * config.tick_hz,
        smoothing=1.0 - exp(-1.0 / (config.smoothing_s * config.tick_hz)),
        floor2=config.floor_m**2,
        max_gap_ticks=float(config.max_gap_ticks),
    )


def estimate_state(config: TremorConfig, params: Record) -> Record:
    """Before the first sample."""
    state = new_record(estimate_state_dtype(len(config.kalman.frequencies_hz)))
    restart_estimate(attributes(state)[0], attributes(params)[0])
    return state


@kernel
def restart_estimate(state: Record, param: Record) -> None:
    """Forget everything."""
    state.kalman[:, :] = 0.0
    for i in range(3):
        wflc_restart(state.combiner[i].wflc, param.combiner.wflc)
        state.combiner[i].memory[:, :] = 0.0
        state.combiner[i].weights[:] = 0.0
    state.predicted[:, :] = 0.0
    state.at = 0
    state.power[:] = 0.0
    state.miss[:] = 0.0
    state.ticks = 0.0
    state.last_tick = np.nan


@kernel
def estimate_kernel(frame: NDArray[np.float64], states: Record, params: Record) -> None:
    """Fill the columns from ``tremor`` to ``confidence``; adds its bits to ``status``.

    Without a valid new sample the model runs on by itself, so that the prediction stays one for the present
    tick; after lost scans it runs on over the gap. Confidence is 1 minus the relative size of what earlier
    predictions missed, and 0 until the estimator has settled.
    """
    state = states[0]
    param = params[0]
    status = int(frame[STATUS])
    tick = frame[TICK]
    if status & (ALIGNING | RESTARTED):
        restart_estimate(state, param)
    coast = status & (INVALID | STALE | ALIGNING) != 0
    if np.isnan(state.last_tick):
        state.last_tick = tick - 1.0
    target = max(state.last_tick + 1.0, tick) if coast else tick
    steps = int(target - state.last_tick)
    if steps > param.max_gap_ticks:
        restart_estimate(state, param)
        steps = 1
    state.last_tick = target
    state.ticks += steps
    settled = state.ticks > param.settle_ticks
    for n in range(steps):
        state.at = (state.at + 1) % HISTORY
        for i in range(3):
            kalman_predict(state.kalman[i], param.kalman)
            if coast or n < steps - 1:
                combiner_coast(state.combiner[i])
    for i in range(3):
        if not coast:
            # the combiner runs in either case: it is also what measures the frequency
            kalman_correct(state.kalman[i], frame[TIP_ACCELERATION + i], param.kalman)
            combiner_step(frame[TIP_ACCELERATION + i], state.combiner[i], param.combiner)
        if param.use_kalman:
            now = combine(state.kalman[i], param.kalman.now)
            ahead = combine(state.kalman[i], param.kalman.ahead)
        else:
            now = combiner_displacement(state.combiner[i], param.combiner, 0.0)
            ahead = combiner_displacement(state.combiner[i], param.combiner, param.combiner.delay_s)
        ring = state.predicted[i]
        missed = now - ring[(state.at - param.delay_ticks) % HISTORY]
        ring[state.at] = ahead
        state.power[i] += param.smoothing * (now * now - state.power[i])
        state.miss[i] += param.smoothing * (missed * missed - state.miss[i])
        frame[TREMOR + i] = now
        frame[TREMOR_AHEAD + i] = ahead
        frame[TREMOR_AMPLITUDE + i] = sqrt(2.0 * state.power[i])
        frame[TREMOR_FREQUENCY + i] = state.combiner[i].wflc.omega * param.combiner.tick_hz / (2.0 * pi)
        confidence = 0.0
        if settled:
            total = state.power[i] + param.floor2
            confidence = max(0.0, 1.0 - sqrt((state.miss[i] + param.floor2) / total))
        frame[CONFIDENCE + i] = confidence
    if not settled:
        status |= SETTLING
    frame[STATUS] = status


class Tremor:
    """The tremor stage with its state; ``step`` works on one frame."""

    def __init__(self, config: TremorConfig) -> None:
        self.config = config
        self.params = estimate_params(config)
        self.state = estimate_state(config, self.params)

    def step(self, frame: NDArray[np.float64]) -> None:
        estimate_kernel(frame, self.state, self.params)

    def reset(self) -> None:
        """As before the first sample."""
        copy_record(self.state, estimate_state(self.config, self.params))
