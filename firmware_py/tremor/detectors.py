"""Detects jerk (myoclonus) and drift on the acceleration of the tip and reports them to the supervisor.

Jerk: between voluntary motion and tremor (below 1 Hz, above 8 Hz) and beyond tremor a quiet hand does little. In both
bands each axis is divided by its own smoothed rms; the sum of squares is then chi-squared with three degrees of freedom
whatever the hand's tremor and the sensor's noise are, and a jerk is what stands out of that. The smoothed power sees
values limited to ``limit`` sigma, so that a jerk does not hide the next one.

Drift: what is left of gravity and bias must stay small. A cumulative sum of what the smoothed acceleration has beyond
``drift_allowed_m_s2`` alarms at ``drift_limit_m_s``, a velocity: how wrong integration has become (Ang 2004, 5.2.2).
"""

from __future__ import annotations

from math import exp, sqrt

import numpy as np
from numpy.typing import NDArray

from firmware_py.biquads import cascade_step
from firmware_py.designs import design
from firmware_py.frame import ALIGNING, DRIFT, INVALID, JERK, RESTARTED, STALE, STATUS, TIP_ACCELERATION
from firmware_py.records import Records, copy_record, field, new, record
from firmware_py.tremor.detector_config import DetectorConfig
from hal.arrays import Array
from hal.compiled import kernel

SECTIONS = 3
BANDS = 2


@record
class DetectParams:
    """Holds the parameters of both detectors."""

    sections: Array = field("1", BANDS, SECTIONS, 5)
    chi2: Array = field("1", BANDS)
    keep: float = field("1")
    limit: float = field("1")
    floor2: float = field("m^2/s^4")
    hold: float = field("1")
    settle: float = field("1")
    slow: float = field("1")
    allowed: float = field("m/s^2")
    drift_limit: float = field("m/s")
    dt: float = field("s")


@record
class DetectState:
    """Holds the detectors' memory."""

    memory: Array = field("m/s^2", BANDS, 3, SECTIONS, 2)
    power: Array = field("m^2/s^4", BANDS, 3)
    slow_mean: Array = field("m/s^2", 3)
    statistic: Array = field("1", BANDS)
    excess: float = field("m/s")
    held: float = field("1")  # ticks that the jerk flag stays up
    ticks: float = field("1")


def detect_params(config: DetectorConfig, tick_hz: float) -> Records[DetectParams]:
    """Return the kernel's parameters."""
    sections = np.stack(
        [
            design(
                "ellip", SECTIONS, config.ripple_dB, config.attenuation_dB, band, "bandpass", output="sos", fs=tick_hz
            )[0]
            for band in (config.slow_hz, config.brisk_hz)
        ]
    )
    return new(
        DetectParams,
        sections=sections[:, :, [0, 1, 2, 4, 5]],
        chi2=(config.slow_chi2, config.brisk_chi2),
        keep=1.0 - exp(-1.0 / (config.background_s * tick_hz)),
        limit=config.limit,
        floor2=config.floor_m_s2**2,
        hold=config.jerk_hold_s * tick_hz,
        settle=config.settle_s * tick_hz,
        slow=1.0 - exp(-1.0 / (config.drift_smoothing_s * tick_hz)),
        allowed=config.drift_allowed_m_s2,
        drift_limit=config.drift_limit_m_s,
        dt=1.0 / tick_hz,
    )


@kernel
def detect_step(x: NDArray[np.float64], state: DetectState, param: DetectParams) -> int:
    """Process one sample of acceleration (3,), m/s^2, and return the bits ``JERK`` and ``DRIFT`` that are set now.

    The background is the running mean over what has come until ``settle`` ticks, then smoothed; no jerk before that.
    """
    state.ticks += 1.0
    gain = max(param.keep, 1.0 / state.ticks)
    slow = max(param.slow, 1.0 / state.ticks)
    settled = state.ticks > param.settle
    # a jerk is no background; still some, or a hand that has become livelier for good would alarm for ever
    learn = gain if state.held <= 0.0 else 0.1 * gain
    size2 = 0.0
    for i in range(3):
        state.slow_mean[i] += slow * (x[i] - state.slow_mean[i])
        size2 += state.slow_mean[i] * state.slow_mean[i]
    jerk = False
    for band in range(BANDS):
        total = 0.0
        for i in range(3):
            y = cascade_step(x[i], state.memory[band, i], param.sections[band])
            power = state.power[band, i] + param.floor2
            square = y * y
            total += square / power
            if settled:
                square = min(square, param.limit * param.limit * power)
            state.power[band, i] += learn * (square - state.power[band, i])
        state.statistic[band] = total
        jerk = jerk or total > param.chi2[band]
    if settled and jerk:
        state.held = param.hold
    elif state.held > 0.0:
        state.held -= 1.0
    state.excess = max(0.0, state.excess + (sqrt(size2) - param.allowed) * param.dt)
    # a cumulative sum without a ceiling would remember a drift long after it is over
    state.excess = min(state.excess, 2.0 * param.drift_limit)
    bits = 0
    if state.held > 0.0:
        bits |= JERK
    if state.excess > param.drift_limit:
        bits |= DRIFT
    return bits


@kernel
def detect_kernel(frame: NDArray[np.float64], states: Records[DetectState], params: Records[DetectParams]) -> None:
    """Add ``JERK`` and ``DRIFT`` to the frame's status; a tick without a valid new sample changes nothing."""
    state = states[0]
    status = int(frame[STATUS])
    if status & (ALIGNING | RESTARTED):
        state.memory[:] = 0.0
        state.power[:] = 0.0
        state.slow_mean[:] = 0.0
        state.statistic[:] = 0.0
        state.excess = 0.0
        state.held = 0.0
        state.ticks = 0.0
    elif status & (INVALID | STALE) == 0:
        frame[STATUS] = status | detect_step(frame[TIP_ACCELERATION : TIP_ACCELERATION + 3], state, params[0])


@kernel
def detect_run(
    samples: NDArray[np.float64], states: Records[DetectState], params: Records[DetectParams], bits: NDArray[np.int64]
) -> None:
    """Run ``detect_step`` over samples (n, 3) and write ``bits`` (n,)."""
    for i in range(len(samples)):
        bits[i] = detect_step(samples[i], states[0], params[0])


class Detectors:
    """Holds both detectors with their state."""

    def __init__(self, config: DetectorConfig, tick_hz: float) -> None:
        self.config = config
        self.params = detect_params(config, tick_hz)
        self.state = new(DetectState)

    def step(self, frame: NDArray[np.float64]) -> None:
        detect_kernel(frame, self.state, self.params)

    def run(self, samples: NDArray[np.float64]) -> NDArray[np.int64]:
        """Return the bits (n,) for accelerations (n, 3). The state carries on."""
        bits = np.zeros(len(samples), dtype=np.int64)
        detect_run(np.ascontiguousarray(samples, dtype=np.float64), self.state, self.params, bits)
        return bits

    def reset(self) -> None:
        copy_record(self.state, new(DetectState))
