"""Runs the tremor stage: acceleration of the tip -> tremor now, tremor over the loop's delay, frequency, confidence.

The band that an estimator passes is set by its own table of the bench, in Hz (``[firmware.tremor.adaptive]
cancel_from_hz, cancel_to_hz``; ``config.py`` has the others). ``filter_cutoff_rad_s`` is not a setting: it states the
RC filter in front of the accelerometers, in rad/s, and follows ``[firmware.sensing] filter_ohm, filter_farad``.

A hold changes nothing here: the stage runs on with every sample and keeps all that it has learned.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from firmware_py.frame import (
    ALIGNING,
    ANGULAR_ACCELERATION,
    CONFIDENCE,
    INVALID,
    QUATERNION,
    RESTARTED,
    SETTLING,
    STALE,
    STATUS,
    TICK,
    TIP_ACCELERATION,
    TREMOR,
    TREMOR_AHEAD,
    TREMOR_AMPLITUDE,
    TREMOR_CORE,
    TREMOR_FREQUENCY,
)
from firmware_py.records import Records, copy_record
from firmware_py.tremor.config import TremorConfig
from firmware_py.tremor.estimator import (
    AHEAD,
    AMPLITUDE,
    CORE,
    FREQUENCY,
    NOW,
    TRUST,
    estimator_learn,
    estimator_output,
    estimator_params,
    estimator_samples,
    estimator_state,
    estimator_ticks,
)
from firmware_py.tremor.family import AXES, TURNS, EstimatorParams, EstimatorState
from hal.compiled import kernel


@kernel
def estimate_kernel(
    frame: NDArray[np.float64], states: Records[EstimatorState], params: Records[EstimatorParams]
) -> None:
    """Fill the columns from ``tremor`` to ``confidence`` and add the bit ``SETTLING`` to ``status``.

    Input: ``tip_acceleration`` (3,) in m/s^2 and ``angular_acceleration`` (3,) in rad/s^2, both in the body frame.
    The attitude (``quaternion``) says into which axes gravity carries the noise of a turn. Output per axis: tremor now,
    tremor ``TremorConfig.loop_delay_s`` later, its core (the part that does not yield when the stroke runs out) and
    amplitude in m, frequency in Hz, confidence from 0 to 1. ``params`` come from ``TremorConfig``
    (``estimator_params``); ``states`` is the memory of the estimator.

    Without a valid new sample (bits ``INVALID``, ``STALE`` or ``ALIGNING``, which count for all axes) all three axes
    coast: the model runs on by itself, so that the prediction is one for the present tick. After lost scans it runs
    over the gap; a gap of more than ``TremorConfig.max_gap_ticks`` restarts it. It also restarts while the attitude is
    aligning. Confidence is 0 until ``TremorConfig.settle_s`` has passed.
    """
    param = params[0]
    status = int(frame[STATUS])
    tick = frame[TICK]
    if status & (ALIGNING | RESTARTED):
        states[0] = param.fresh
    state = states[0]
    coast = status & (INVALID | STALE | ALIGNING) != 0
    if np.isnan(state.last_tick):
        state.last_tick = tick - 1.0
    target = max(state.last_tick + 1.0, tick) if coast else tick
    steps = int(target - state.last_tick)
    if steps > param.max_gap_ticks:
        states[0] = param.fresh
        steps = 1
    state.last_tick = target
    estimator_ticks(state, steps, coast, param)
    if not coast:
        for i in range(AXES):
            state.samples[i] = frame[TIP_ACCELERATION + i]
            for c in range(TURNS):
                turned = 0.0
                for j in range(AXES):
                    turned += param.lever[i, c, j] * frame[ANGULAR_ACCELERATION + j]
                state.turned[i, c] = turned
        w, x, y, z = frame[QUATERNION], frame[QUATERNION + 1], frame[QUATERNION + 2], frame[QUATERNION + 3]
        up = state.up
        up[0], up[1], up[2] = 2.0 * (x * z - w * y), 2.0 * (y * z + w * x), 1.0 - 2.0 * (x * x + y * y)
        estimator_samples(state, param)
    estimator_output(state, param)
    for i in range(AXES):
        frame[TREMOR + i] = state.out[NOW, i]
        frame[TREMOR_AHEAD + i] = state.out[AHEAD, i]
        frame[TREMOR_CORE + i] = state.out[CORE, i]
        frame[TREMOR_AMPLITUDE + i] = state.out[AMPLITUDE, i]
        frame[TREMOR_FREQUENCY + i] = state.out[FREQUENCY, i]
        frame[CONFIDENCE + i] = state.out[TRUST, i]
    if state.ticks <= param.settle_ticks:
        status |= SETTLING
    frame[STATUS] = status


@kernel
def learn_kernel(frame: NDArray[np.float64], states: Records[EstimatorState], params: Records[EstimatorParams]) -> None:
    """Run now the work with which ``estimate_kernel`` would begin the next tick; see ``Family.learn``."""
    estimator_learn(0, states[0], params[0])


class Tremor:
    """Holds the configuration, parameters and state of the tremor stage."""

    def __init__(self, config: TremorConfig) -> None:
        self.config = config
        self.params = estimator_params(config)
        self.state = estimator_state(self.params)

    def step(self, frame: NDArray[np.float64]) -> None:
        """Compute one tick in place; ``frame`` is the vector of ``firmware_py.frame``."""
        estimate_kernel(frame, self.state, self.params)

    def reset(self) -> None:
        """Restore the state before the first sample."""
        copy_record(self.state, estimator_state(self.params))
