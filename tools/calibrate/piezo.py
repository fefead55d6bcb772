"""Prandtl-Ishlinskii model of a piezo stack from recordings of drive and displacement (000, 7.2.3; ERRATA 74).

The forward model z = z0 + S(w . H_r[u]) is not linear in its weights, but S^-1(z - z0) = w . H_r[u] is: dead-zone
weights of the inverse and play weights are found together by one linear least squares (Kuhnen). Play weights are
kept from going negative, the first one and the zones' partial sums well above zero, so that the inverse always
exists and a lag cannot hide in a steep first play. A lag between drive and
displacement looks like hysteresis that grows with speed, so it is estimated first and reported.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import lsq_linear, minimize_scalar

from firmware_py.actuation.config import StackConfig
from firmware_py.actuation.hysteresis import inverse_thresholds, inverse_weights
from hal.compiled import kernel
from tools.calibrate.calibration_file import calibration_toml
from tools.cli.common import InputError
from tools.mismatch.recording import Recording

Array = NDArray[np.float64]

# fractions of half the drive's range: fine where a tremor's small loops run, coarse beyond (000, 7.2.1)
PLAY_FRACTIONS = (0.0, 0.01, 0.02, 0.04, 0.07, 0.11, 0.16, 0.22, 0.3, 0.4, 0.5, 0.62, 0.76, 0.9)
# fractions of the displacement's range
ZONE_FRACTIONS = (0.0, 0.5, 0.7, 0.85)
LEAST_SUM = 0.05  # smallest partial sum, relative to the mean slope
FIT_SHARE = 0.7
MAX_LAG_S = 0.02
ITERATIONS = 4


@dataclass(frozen=True)
class PiezoFit:
    """One identified stack. Residuals in um; ``held_out`` is the last 30 % of the recording, which no fit saw,
    simulated from the recording's start."""

    stack: StackConfig
    lag_s: float
    rms_um: float
    held_out_rms_um: float
    held_out_max_um: float
    linear_rms_um: float
    range_um: float
    warnings: tuple[str, ...]


@kernel
def plays(drive: Array, r: Array) -> Array:
    """(n, len(r)) outputs of the play operators for a drive that came up from zero to its first value."""
    out = np.empty((len(drive), len(r)))
    y = np.maximum(drive[0] - r, 0.0)
    for k in range(len(drive)):
        for i in range(len(r)):
            y[i] = max(drive[k] - r[i], min(drive[k] + r[i], y[i]))
            out[k, i] = y[i]
    return out


def determined_from(drive: Array) -> int:
    """First sample at which the plays no longer depend on what came before the recording: the drive has been at
    its lowest and at its highest by then (the larger swing wipes out the memory of the smaller)."""
    span = np.ptp(drive)
    low = int(np.argmax(drive <= drive.min() + 0.01 * span))
    high = int(np.argmax(drive >= drive.max() - 0.01 * span))
    return max(low, high)


def delayed(drive: Array, lag_s: float, dt: float) -> Array:
    """``drive`` as it was ``lag_s`` ago, linear between samples."""
    t = np.arange(len(drive)) * dt
    return np.interp(t - lag_s, t, drive)


def _solve(drive: Array, z: Array, r: Array, d: Array, rows: slice) -> tuple[Array, Array, float]:
    """Play weights w, weights s' of the inverse dead zones (s'_0 = 1) and z0, thresholds ``d`` on z - z0."""
    h = plays(drive, r)[rows]
    z = z[rows]
    slope = np.ptp(z) / np.ptp(drive)
    z0 = float(z.min())
    w = np.zeros(len(r))
    s = np.zeros(len(d))
    s[0] = 1.0
    for _ in range(ITERATIONS):
        zones = np.maximum(z[:, None] - z0 - d[1:], 0.0)
        # sum_{j >= 1} s'_j S_j in the partial sums T_j = 1 + s'_1 + ... + s'_j: (T_j - T_{j-1}) S_j
        steps = zones.copy()
        steps[:, :-1] -= zones[:, 1:]
        target = z - z0 - (zones[:, 0] if zones.shape[1] else 0.0)
        scale = np.concatenate([np.ones(len(r)), np.full(steps.shape[1], slope), [slope * 100.0]])
        low = np.concatenate([np.zeros(len(r)), np.full(steps.shape[1], LEAST_SUM), [-np.inf]])
        low[0] = LEAST_SUM * slope
        solution = _bounded(np.column_stack([h, -steps, np.ones(len(z))]) * scale, target, low / scale) * scale
        w = solution[: len(r)].copy()
        s[1:] = np.diff(solution[len(r) : -1], prepend=1.0)
        shift = float(solution[-1])
        z0 += shift
        if abs(shift) < 1e-6 * np.ptp(z):
            break
    return w, s, z0


def _bounded(design: Array, target: Array, low: Array) -> Array:
    """Least squares with lower bounds; the many rows are first reduced to as many as there are columns."""
    triangle: Any = np.linalg.qr(np.column_stack([design, target]), mode="r")
    result: Any = lsq_linear(triangle[:, :-1], triangle[:, -1], bounds=(low, np.inf))
    return np.asarray(result.x, dtype=np.float64)


def simulate(stack: StackConfig, drive: Array) -> Array:
    """Displacement um of the forward model for a drive V that came up from zero."""
    y = plays(drive, np.array(stack.play_thresholds_V)) @ np.array(stack.play_weights_um_per_V)
    d, s = np.array(stack.dead_zone_thresholds_um), np.array(stack.dead_zone_weights)
    z = s[0] * y + np.maximum(y[:, None] - d[1:], 0.0) @ s[1:]
    return z + stack.offset_um


def _stack(r: Array, w: Array, d: Array, s: Array, z0: float) -> StackConfig:
    # the zones were found for the inverse; transforming an inverse gives the forward operator back
    return StackConfig(
        play_thresholds_V=tuple(map(float, r)),
        play_weights_um_per_V=tuple(map(float, w)),
        dead_zone_thresholds_um=tuple(map(float, inverse_thresholds(d, s))),
        dead_zone_weights=tuple(map(float, inverse_weights(s))),
        offset_um=z0,
    )


def identify_stack(recording: Recording) -> PiezoFit:
    """Fit one stack to one recording of kind ``piezo_stack``. Raises ``InputError`` when it cannot be."""
    where = recording.path
    if "command" not in recording.inputs or "displacement" not in recording.outputs:
        raise InputError(f"{where}: a piezo calibration needs channels with signals 'command' and 'displacement'")
    drive, z = recording.inputs["command"], recording.outputs["displacement"]
    span = float(np.ptp(drive))
    start, stop = determined_from(drive), round(FIT_SHARE * len(drive))
    if span <= 0.0 or stop - start < 20 * len(PLAY_FRACTIONS):
        raise InputError(
            f"{where}: the drive must visit its lowest and highest value early and then go on for a while; "
            f"only {max(0, stop - start)} of {len(drive)} samples can be fitted"
        )
    rows = slice(start, stop)
    r = 0.5 * span * np.array(PLAY_FRACTIONS)
    d = float(np.ptp(z)) * np.array(ZONE_FRACTIONS)
    few = slice(start, stop, 5)  # enough for one number

    def misfit(lag_s: float) -> float:
        shifted = delayed(drive, lag_s, recording.dt)
        w, s, z0 = _solve(shifted, z, r, d[:1], few)
        return float(np.std(z[few] - simulate(_stack(r, w, d[:1], s, z0), shifted)[few]))

    found: Any = minimize_scalar(misfit, bounds=(0.0, MAX_LAG_S), method="bounded", options={"xatol": 2e-5})
    lag_s = float(found.x)
    if misfit(0.0) < 1.02 * misfit(lag_s):
        lag_s = 0.0
    shifted = delayed(drive, lag_s, recording.dt)
    fits = [_stack(r, *_with_zones(shifted, z, r, zones, rows)) for zones in (d[:1], d)]
    errors = [z - simulate(stack, shifted) for stack in fits]
    # more zones only when they earn their place
    best = 1 if np.std(errors[1][rows]) < 0.97 * np.std(errors[0][rows]) else 0
    line = np.polyfit(drive[rows], z[rows], 1)
    held = errors[best][stop:]
    return PiezoFit(
        stack=fits[best],
        lag_s=lag_s,
        rms_um=float(np.std(errors[best][rows])),
        held_out_rms_um=float(np.sqrt(np.mean(held**2))),
        held_out_max_um=float(np.max(np.abs(held))),
        linear_rms_um=float(np.std(z[rows] - np.polyval(line, drive[rows]))),
        range_um=float(np.ptp(z)),
        warnings=tuple(_missing(drive, span)),
    )


def _with_zones(drive: Array, z: Array, r: Array, d: Array, rows: slice) -> tuple[Array, Array, Array, float]:
    w, s, z0 = _solve(drive, z, r, d, rows)
    return w, d, s, z0


def _missing(drive: Array, span: float) -> list[str]:
    """What the excitation did not contain, in words."""
    turns = drive[1:-1][np.diff(np.sign(np.diff(drive))) != 0]
    swings = np.abs(np.diff(turns))
    problems: list[str] = []
    if span < 80.0:
        problems.append(f"the drive covers {span:.0f} V; beyond that the model is a guess: record 0 to 100 V")
    if len(swings) == 0 or np.min(swings) > 0.15 * span:
        problems.append("no small loops: add sinusoids of a few volts, where a tremor is cancelled")
    if len(swings) < 10:
        problems.append(f"only {len(swings) + 1} reversals: record more cycles of different size")
    return problems


def excitation_V(rate_hz: float, seconds: float = 40.0, centre_V: float = 50.0, low_V: float = 0.0) -> Array:
    """A drive that identifies all of the model: two full sweeps, then 10 Hz loops that shrink from full range to
    2 V, with a slow wander of their centre."""
    t = np.arange(round(seconds * rate_hz)) / rate_hz
    half = centre_V - low_V
    sweep_s = 0.1 * seconds
    sweep = 0.5 * half * (1.0 - np.cos(2.0 * np.pi * t / (0.5 * sweep_s))) * 2.0
    size = half * np.exp(-np.log(half) * (((t - sweep_s) * 4.0 / (seconds - sweep_s)) % 1.0))
    room = half - size
    loops = centre_V + size * np.sin(2.0 * np.pi * 10.0 * t) + 0.9 * room * np.sin(2.0 * np.pi * 0.31 * t)
    return np.clip(np.where(t < sweep_s, low_V + sweep, loops), low_V, low_V + 2.0 * half)


def piezo_calibration(fits: Sequence[PiezoFit], title: str) -> str:
    """Calibration file for the firmware: one fit for all three stacks, or one per stack in order 1, 2, 3."""
    if len(fits) not in (1, 3):
        raise InputError(f"{len(fits)} recordings: give one (for all three stacks) or three (stacks 1, 2, 3)")
    stacks: list[dict[str, Any]] = [
        {key: list(v) if isinstance(v, tuple) else v for key, v in fit.stack.model_dump().items()} for fit in fits
    ]
    return calibration_toml(title, "micron calibrate piezo", {"actuation": {"stacks": stacks * (3 // len(stacks))}})
