"""Amplifier lag and resonance of a stack from small steps of its drive.

A step rings at the mechanism's own frequency, whatever the hysteresis does to its size. All steps of a recording, up
and down, are laid over each other; creep and the slow part of the slip go into their own terms.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from scipy.optimize import minimize

from hal.arrays import Array
from tools.calibrate.piezo_dynamics import Dynamics
from tools.errors import InputError
from tools.mismatch.recording import Recording

LONGEST_S = 0.03
SLOW_S = (10e-3, 50e-3)
LEAST_STEPS = 8


def is_steps(recording: Recording) -> bool:
    """Return True if the drive rests nearly always and jumps now and then."""
    drive = recording.inputs.get("command")
    if drive is None or len(drive) < 2:
        return False
    jumps = int(np.count_nonzero(np.diff(drive)))
    return 0 < jumps < 0.02 * len(drive)


def mean_step(recording: Recording) -> tuple[Array, float]:
    """(n,) displacement um after a step up, mean over all steps, from 0 before it; rms of its noise, um.

    Raises ``InputError`` when the steps are too few or too close together.
    """
    drive, z = recording.inputs["command"], recording.outputs["displacement"]
    changes = np.diff(drive)
    at = np.flatnonzero(changes) + 1
    length = int(min(LONGEST_S / recording.dt, np.min(np.diff(at, append=len(drive)))))
    before = max(2, length // 4)
    at = at[at >= before]
    if len(at) < LEAST_STEPS or length < 20:
        raise InputError(
            f"{recording.path}: {len(at)} steps, {1e3 * length * recording.dt:.1f} ms apart: steps need at least "
            f"{LEAST_STEPS} of them and 20 samples from each to the next"
        )
    cut = np.stack([(z[k : k + length] - z[k - before : k].mean()) * np.sign(changes[k - 1]) for k in at])
    return cut.mean(axis=0), float(np.std(cut, axis=0).mean() / np.sqrt(len(at)))


def fit_steps(recording: Recording) -> Dynamics:
    """Fit lag, resonance and damping. No resonance is returned when none exceeds the noise."""
    z, noise = mean_step(recording)
    t: Array = np.arange(len(z), dtype=np.float64) * recording.dt
    # a slow response is hysteresis and creep, not lag
    slow = [-np.expm1(-t / tau) for tau in SLOW_S]

    def left(dynamics: Dynamics) -> float:
        columns = np.stack([dynamics.step(t), *slow], axis=1)
        size = np.linalg.lstsq(columns, z, rcond=None)[0]
        return float(np.mean((z - columns @ size) ** 2))

    def with_mode(p: Array) -> Dynamics:
        lag_s, resonance_hz, damping = map(float, np.exp(np.minimum(p, 20.0)))
        return Dynamics(0.0, lag_s, resonance_hz, damping)

    def misfit(p: Array) -> float:
        d = with_mode(p)
        return left(d) if d.damping < 0.9 and d.resonance_hz < 0.5 / recording.dt and d.lag_s < SLOW_S[0] else 1e6

    # the ringing is the strongest line of the rate
    power = np.abs(np.fft.rfft(np.diff(z) * np.hanning(2 * len(z))[len(z) + 1 :], 8 * len(z)))
    hz = np.fft.rfftfreq(8 * len(z), recording.dt)
    usable = hz > 2.0 / (len(z) * recording.dt)
    start_hz = float(hz[usable][np.argmax(power[usable])])
    options = {"maxfev": 600, "xatol": 1e-4, "fatol": 1e-12}
    starts = [np.log([recording.dt, start_hz, damping]) for damping in (0.03, 0.2)]
    tried: list[Any] = [minimize(misfit, x0, method="Nelder-Mead", options=options) for x0 in starts]
    best = min(tried, key=lambda result: result.fun)
    # without a resonance: what a lag alone leaves
    lag: Any = minimize(
        lambda p: left(Dynamics(lag_s=float(np.exp(min(p[0], 0.0))))), [np.log(recording.dt)], method="Nelder-Mead"
    )
    if best.fun + noise**2 > 0.5 * (lag.fun + noise**2):
        return Dynamics(lag_s=float(np.exp(lag.x[0])))
    return with_mode(best.x)
