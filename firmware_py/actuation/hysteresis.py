"""Modified Prandtl-Ishlinskii hysteresis and its exact inverse (000, 7.2; ERRATA 73, 74).

Forward: z = w_s . S_d(w_h . H_r[x, y0]), plays H_r with memory, then one-sided dead zones S_d without. The
inverse has the same form with transformed weights, thresholds and initial states, the dead zones first.
Units: drive x in V, z in m (weights m/V); dead-zone thresholds in the unit of w_h . H_r, m.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from firmware_py.actuation.config import StackConfig
from firmware_py.records import Record, new_record
from hal.compiled import kernel

Array = NDArray[np.float64]
UM = 1e-6


def operator_dtype(n_plays: int, n_zones: int) -> np.dtype[Any]:
    """Numbers of one stack: the forward operator, and its inverse (names ending in ``_inverse``)."""
    return np.dtype(
        [
            ("r", "f8", (n_plays,)),
            ("w", "f8", (n_plays,)),
            ("sums", "f8", (n_plays,)),  # W_i, partial sums of w
            ("d", "f8", (n_zones,)),
            ("s", "f8", (n_zones,)),
            ("r_inverse", "f8", (n_plays,)),
            ("w_inverse", "f8", (n_plays,)),
            ("d_inverse", "f8", (n_zones,)),
            ("s_inverse", "f8", (n_zones,)),
            ("offset", "f8"),
        ]
    )


def inverse_weights(w: Array) -> Array:
    """000 (7.13), (7.14): weights of the inverse from the forward ones; partial sums must be positive."""
    sums = np.cumsum(w)
    return np.concatenate([[1.0 / w[0]], -w[1:] / (sums[1:] * sums[:-1])])


def inverse_thresholds(r: Array, w: Array) -> Array:
    """r'_i = sum_{j <= i} w_j (r_i - r_j)."""
    return np.array([np.sum(w[: i + 1] * (r[i] - r[: i + 1])) for i in range(len(r))])


def inverse_states(w: Array, y: Array) -> Array:
    """y'_i = W_i y_i + sum_{j > i} w_j y_j: play states of the inverse from those of the forward operator."""
    return np.cumsum(w) * y + np.array([np.sum(w[i + 1 :] * y[i + 1 :]) for i in range(len(w))])


def plays_after_rise(r: Array, drive_V: float) -> Array:
    """Play states of a de-energised stack whose drive has risen from 0 to ``drive_V``."""
    return np.maximum(drive_V - r, 0.0)


def operator_params(stack: StackConfig) -> Record:
    """The kernels' numbers of one stack (dtype ``operator_dtype``)."""
    r = np.array(stack.play_thresholds_V)
    w = np.array(stack.play_weights_um_per_V) * UM
    d = np.array(stack.dead_zone_thresholds_um) * UM
    s = np.array(stack.dead_zone_weights)
    return new_record(
        operator_dtype(len(r), len(d)),
        r=r,
        w=w,
        sums=np.cumsum(w),
        d=d,
        s=s,
        r_inverse=inverse_thresholds(r, w),
        w_inverse=inverse_weights(w),
        d_inverse=inverse_thresholds(d, s),
        s_inverse=inverse_weights(s),
        offset=stack.offset_um * UM,
    )


@kernel
def play(x: float, states: Array, r: Array, w: Array) -> float:
    """w . H_r[x]: moves the play ``states`` and sums them, 000 (7.1), (7.4)."""
    total = 0.0
    for i in range(len(r)):
        y = max(x - r[i], min(x + r[i], states[i]))
        states[i] = y
        total += w[i] * y
    return total


@kernel
def dead_zones(y: float, d: Array, s: Array) -> float:
    """s . S_d(y), 000 (7.7), (7.8); d[0] = 0 passes y of either sign."""
    total = s[0] * y
    for i in range(1, len(d)):
        total += s[i] * max(y - d[i], 0.0)
    return total


@kernel
def extension(drive_V: float, states: Array, stack: Record) -> float:
    """Forward model: extension m of the stack at ``drive_V``; moves the forward play ``states``."""
    return dead_zones(play(drive_V, states, stack.r, stack.w), stack.d, stack.s) + stack.offset


@kernel
def drive(extension_m: float, states: Array, stack: Record) -> float:
    """Inverse model: drive V that gives ``extension_m``; moves the inverse play ``states``."""
    linear = dead_zones(extension_m - stack.offset, stack.d_inverse, stack.s_inverse)
    return play(linear, states, stack.r_inverse, stack.w_inverse)


@kernel
def follow_drive(drive_V: float, states: Array, stack: Record) -> None:
    """Move the inverse's play ``states`` as if it had asked for ``drive_V`` (what a limit left of the wish).

    Undoes y'_i = W_i y_i + sum_{j > i} w_j y_j from the last play to the first, moves the forward plays, and
    maps them back.
    """
    before = 0.0
    after = 0.0
    for i in range(len(stack.r) - 1, -1, -1):
        y = (states[i] - before) / stack.sums[i]
        moved = max(drive_V - stack.r[i], min(drive_V + stack.r[i], y))
        states[i] = stack.sums[i] * moved + after
        before += stack.w[i] * y
        after += stack.w[i] * moved
