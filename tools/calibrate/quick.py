"""The three quick accelerometer calibrations of 002 sec. 5.2.1: slow turn through 360 degrees, fall, flat surface."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from tools.calibrate.multi_position import Estimate
from tools.errors import InputError

Array = NDArray[np.float64]
LARGEST_TURN_RESIDUAL = 0.15
LEAST_TURN_STEPS = 20.0
"""Range of an axis over the rms change from sample to sample: 600 for a slow turn, 7 for noise."""
LARGEST_FLAT_SPREAD_G = 0.05
LARGEST_FLAT_BIAS_G = 0.5


@dataclass(frozen=True)
class QuickResult:
    """``parameters`` in the log's unit (``bias_*``; ``scale_*`` per g where the method shows it)."""

    method: str
    parameters: dict[str, Estimate]
    samples: int
    residual: float
    missing: tuple[str, ...]


def _mean(values: Array) -> Estimate:
    """Mean with a 95 % interval from 16 block means (samples behind a filter are not independent)."""
    blocks = np.array([part.mean() for part in np.array_split(values, 16)])
    reach = 2.13 * blocks.std(ddof=1) / 4.0  # Student, 15 degrees of freedom
    centre = float(values.mean())
    return Estimate(centre, centre - float(reach), centre + float(reach))


def turn(raw: Array) -> QuickResult:
    """Offset (max + min) / 2 and scale (max - min) / 2 of every axis (ERRATA 116), over the outermost 0.5 %."""
    count = max(3, len(raw) // 200)
    if len(raw) < 50:
        raise InputError(f"{len(raw)} samples: turn slowly through 360 degrees about two axes")
    parameters: dict[str, Estimate] = {}
    ordered = np.sort(raw, axis=0)
    low, high = ordered[:count], ordered[-count:]
    reach = np.median(np.ptp(ordered, axis=0))
    missing = []
    for i, axis in enumerate("xyz"):
        bottom, top = low[:, i], high[:, i]
        error = 1.96 * float(np.hypot(bottom.std(ddof=1), top.std(ddof=1))) / 2.0
        bias, scale = float(bottom.mean() + top.mean()) / 2.0, float(top.mean() - bottom.mean()) / 2.0
        parameters[f"bias_{axis}"] = Estimate(bias, bias - error, bias + error)
        parameters[f"scale_{axis}"] = Estimate(scale, scale - error, scale + error)
        if 2.0 * scale < 0.8 * reach:
            missing.append(f"{axis} up and down")
    bias = np.array([parameters[f"bias_{a}"].value for a in "xyz"])
    scale = np.array([parameters[f"scale_{a}"].value for a in "xyz"])
    steps = np.std(np.diff(raw, axis=0), axis=0)
    if np.sum(np.ptp(raw, axis=0) > LEAST_TURN_STEPS * steps) < 2:
        raise InputError("it does not turn: readings go no further than their noise on two axes or all three")
    size = np.linalg.norm((raw - bias) / np.maximum(scale, 1e-300), axis=1)
    residual = float(np.std(size))
    if not missing and max(residual, abs(float(size.mean()) - 1.0)) > LARGEST_TURN_RESIDUAL:
        raise InputError(
            f"|a| is {size.mean():.2f} +- {residual:.2f} g with what the extremes say: no slow turn through 360 "
            "degrees about two axes"
        )
    return QuickResult("turn", parameters, len(raw), residual, tuple(missing))


def free_fall(raw: Array, rate_hz: float, counts_per_g: float, longest_s: float = 2.0) -> QuickResult:
    """Offset of every axis while nothing is felt: the longest run below 0.2 g about its own mean, ends trimmed."""
    force = raw / counts_per_g
    weightless = np.concatenate([[False], np.linalg.norm(force, axis=1) < 0.35, [False]])
    bounds = np.flatnonzero(np.diff(weightless.astype(np.int8))).reshape(-1, 2)
    if len(bounds) == 0:
        raise InputError("no free fall: |a| never stays below 0.35 g")
    first, last = bounds[np.argmax(bounds[:, 1] - bounds[:, 0])]
    trim = (last - first) // 10
    first, last = first + trim, last - trim
    if last - first < 16:
        raise InputError(f"the longest fall has {last - first} samples after trimming; 16 are needed: drop from higher")
    if (last - first) / rate_hz > longest_s:
        raise InputError(f"|a| is below 0.35 g for {(last - first) / rate_hz:.1f} s: that is no fall; check --scale")
    part = raw[first:last]
    return QuickResult(
        "fall",
        {f"bias_{axis}": _mean(part[:, i]) for i, axis in enumerate("xyz")},
        len(part),
        float(np.linalg.norm(part.std(axis=0))),
        ("scale: a fall does not show it",),
    )


def flat(raw: Array, counts_per_g: float, up: str) -> QuickResult:
    """Offset while lying flat with axis ``up`` ("x", "-z", ...) up: its 1 g is taken off first (ERRATA 115)."""
    axis = "xyz".find(up[-1])
    if axis < 0 or up[:-1] not in ("", "-", "+"):
        raise InputError(f"up = '{up}': name an axis, as z or -z")
    if len(raw) < 32:
        raise InputError(f"{len(raw)} samples: 32 are needed")
    level = np.zeros(3)
    level[axis] = -counts_per_g if up[0] == "-" else counts_per_g
    part = raw - level
    moving = float(part.std(axis=0).max()) / counts_per_g
    if moving > LARGEST_FLAT_SPREAD_G:
        raise InputError(f"the readings spread by {moving:.2g} g: it moves; let it lie still")
    off = part.mean(axis=0) / counts_per_g
    worst = int(np.argmax(np.abs(off)))
    if abs(off[worst]) > LARGEST_FLAT_BIAS_G:
        raise InputError(
            f"axis {'xyz'[worst]} would have an offset of {off[worst]:.2f} g: is {up} the axis that points up, and are "
            f"{counts_per_g:g} counts one g?"
        )
    return QuickResult(
        "flat",
        {f"bias_{name}": _mean(part[:, i]) for i, name in enumerate("xyz")},
        len(part),
        float(np.linalg.norm(part.std(axis=0))),
        ("scale, and tilt of the table: they look like bias",),
    )
