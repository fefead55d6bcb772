"""Implements the quick accelerometer calibrations of Erat 2018, sec. 5.2.1: slow turn by 360 degrees, fall, flat.

Each fits as many numbers as it has mean readings, so no residual is left. The intervals come from the readings within
the poses and do not include a pose that differs from the assumed one (``limits``).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import median_filter
from scipy.stats import t as student

from hal.arrays import Array
from tools.calibrate.multi_position import Estimate, missing_poses
from tools.calibrate.still import spread
from tools.errors import InputError

Rows = NDArray[np.int64]
LARGEST_TURN_RESIDUAL = 0.15
LEAST_TURN_STEPS = 20.0
"""Range of an axis over the rms change from sample to sample: 600 for a slow turn, 7 for noise."""
FEW_TURN_SAMPLES = 1000
"""Readings below which the intervals are too short: with 300, 73 % of them hold the truth; from 2000 on, 99 %."""
LARGEST_FLAT_SPREAD_G = 0.05
LARGEST_FLAT_BIAS_G = 0.5
LEAST_REACH = 0.8
"""Range of an axis over the largest; an axis 35 degrees from the vertical still reads 0.82 g."""
POSE_SINE = float(np.sin(np.radians(35.0)))
FALL_G = 0.5
"""Size of the reading below which a free fall is searched."""
SHORTEST_FALL_S, LONGEST_FALL_S = 0.05, 2.0
BOUNCE_S = 0.005
"""A disturbance shorter than this does not end a fall."""
NEAR_G = 0.1
"""Largest distance of a reading from the quietest part of a fall."""
EDGE_SHARE = 0.1
"""Part of a fall that is left out at either end."""
UNDITHERED_STEPS = 0.475
"""Half of 95 % of one quantisation step: what a mean of equal readings can be off by."""


@dataclass(frozen=True)
class NormCheck:
    """|a| in g over ``samples`` that the fit did not use: mean, and rms from 1 g."""

    samples: int
    mean_g: float
    rms_error_g: float


@dataclass(frozen=True)
class QuickResult:
    """``parameters`` in the log's unit (``bias_*``; ``scale_*`` per g where the method shows it).

    ``readings`` are the means that were fitted, ``freedom`` how many more they are than parameters; without any
    ``residual`` is None. ``noise``: rms of a reading about the mean of its pose, largest axis, log's unit.
    ``condition`` of the design; ``missing`` poses or steps; ``limits``: what the method cannot tell.
    """

    method: str
    parameters: dict[str, Estimate]
    samples: int
    poses: int
    readings: int
    freedom: int
    residual: float | None
    noise: float
    condition: float
    check: NormCheck | None
    missing: tuple[str, ...]
    limits: tuple[str, ...]

    def lines(self) -> list[str]:
        """Return the lines of a report."""
        lines = [
            f"{self.poses} pose{'s' if self.poses > 1 else ''}: {self.readings} mean readings for "
            f"{len(self.parameters)} parameters, condition {self.condition:.1f}",
            "residual: none left, as many poses as parameters; intervals are from the readings within the poses "
            f"(spread {self.noise:.3g} rms)",
        ]
        if self.check is not None:
            lines.append(
                f"check on {self.check.samples} readings that were not fitted: |a| {self.check.mean_g:.4f} g, off by "
                f"{self.check.rms_error_g:.4f} g rms"
            )
        return lines + [f"not told: {text}" for text in self.limits]


def _exact(
    method: str,
    parameters: dict[str, Estimate],
    design: Array,
    samples: int,
    noise: float,
    missing: tuple[str, ...],
    *,
    limits: tuple[str, ...],
    check: NormCheck | None = None,
) -> QuickResult:
    """Return the result of a fit with one reading for every parameter. ``design`` is (readings, parameters)."""
    readings, count = design.shape
    assert readings == count == len(parameters)
    poses = 1 if method in ("fall", "flat") else readings
    condition = float(np.linalg.cond(design))
    return QuickResult(method, parameters, samples, poses, readings, 0, None, noise, condition, check, missing, limits)


def _step(values: Array) -> float:
    """Return the smallest difference of two readings of an axis in ``values`` (n, 3): one count, if they are counts."""
    steps = np.concatenate([np.diff(np.unique(column)) for column in values.T])
    if len(steps) == 0:
        raise InputError("the readings do not change at all: are they the right columns, is the sensor running?")
    return float(steps.min())


def _one_pose(values: Array) -> dict[str, Estimate]:
    """Return the means of ``values`` (n, 3) with 95 % intervals from 16 block means (samples behind a filter are not
    independent)."""
    step = _step(values)
    estimates: dict[str, Estimate] = {}
    for i, axis in enumerate("xyz"):
        blocks = np.array([part.mean() for part in np.array_split(values[:, i], 16)])
        reach = 2.131 * float(blocks.std(ddof=1)) / 4.0  # Student, 15 degrees of freedom
        if values[:, i].std() < 0.5 * step:
            reach = max(reach, UNDITHERED_STEPS * step)
        estimates[f"bias_{axis}"] = Estimate.around(values[:, i].mean(), reach)
    return estimates


def _extremes(raw: Array) -> tuple[Rows, Rows]:
    """Return the samples (k, 3) that are each axis' lowest and highest 0.5 %, by the median of their neighbours.

    By its own value a sample would be chosen for its noise, and the scale would come out too large.
    """
    count, reach = max(3, len(raw) // 200), max(1, min(8, len(raw) // 200))
    neighbours = np.ones((2 * reach + 1, 1), dtype=bool)
    neighbours[reach] = False
    order = np.argsort(median_filter(raw, footprint=neighbours, mode="nearest"), axis=0, kind="stable")
    return order[:count], order[-count:]


def _missing_turns(raw: Array, low: Rows, high: Rows, bias: Array, scale: Array) -> tuple[str, ...]:
    """Return the poses that no axis reached. ``low`` and ``high`` are the samples of the extremes."""
    is_known = scale >= LEAST_REACH * scale.max()
    force = (raw - bias) / np.where(is_known, scale, np.inf)  # an unknown axis counts as zero
    missing: list[str] = []
    for i in np.flatnonzero(~is_known):
        # an upright axis leaves 0 g to the known others, and reads 0 g while one of them is upright
        upright = scale[i] >= LEAST_REACH / 2.0 * scale.max()
        words = [
            f"{'xyz'[i]} {word}"
            for word, at in (("up", high), ("down", low))
            if not upright or np.median(np.linalg.norm(force[at[:, i]], axis=1)) > POSE_SINE
        ]
        missing += words or [f"{'xyz'[i]} up", f"{'xyz'[i]} down"]
    return tuple(missing)


def turn(raw: Array) -> QuickResult:
    """Offset (max + min) / 2 and scale (max - min) / 2 of every axis that was turned up and down (erratum 116)."""
    if len(raw) < 50:
        raise InputError(f"{len(raw)} samples: turn slowly through 360 degrees about two axes")
    step, steps = _step(raw), np.std(np.diff(raw, axis=0), axis=0)
    if np.sum(np.ptp(raw, axis=0) > LEAST_TURN_STEPS * steps) < 2:
        raise InputError("it does not turn: readings go no further than their noise on two axes or all three")
    low, high = _extremes(raw)
    bottom, top = np.take_along_axis(raw, low, axis=0), np.take_along_axis(raw, high, axis=0)
    # medians: a spike or a cut log is not an extreme
    up, down = np.median(top, axis=0), np.median(bottom, axis=0)
    bias, scale = (up + down) / 2.0, (up - down) / 2.0
    missing = _missing_turns(raw, low, high, bias, scale)
    axes = [i for i, axis in enumerate("xyz") if not any(pose[0] == axis for pose in missing)]
    scatter = 1.4826 * np.hypot(np.median(np.abs(top - up), axis=0), np.median(np.abs(bottom - down), axis=0))
    if len(axes) < 2:
        raise InputError(f"missing: {', '.join(missing)}: turn slowly through 360 degrees about two axes")
    wide = float(student.ppf(0.975, len(low) - 1))
    parameters: dict[str, Estimate] = {}
    for i in axes:
        # the scatter itself, not that of a mean: an extreme is passed and not held, and its flank reads less
        error = max(wide * float(scatter[i]) / 2.0, UNDITHERED_STEPS * step)
        for name, value in ((f"bias_{'xyz'[i]}", float(bias[i])), (f"scale_{'xyz'[i]}", float(scale[i]))):
            parameters[name] = Estimate.around(value, error)
    rest = np.ones(len(raw), dtype=bool)
    rest[np.concatenate([low, high])[:, axes].ravel()] = False
    size = np.linalg.norm((raw[rest][:, axes] - bias[axes]) / scale[axes], axis=1)
    check = None
    if missing:
        # the axis that is not told takes its part of 1 g: the others read less, never more
        wrong = float(np.quantile(size, 0.99)) > 1.0 + LARGEST_TURN_RESIDUAL
    else:
        check = NormCheck(len(size), float(size.mean()), float(np.sqrt(np.mean((size - 1.0) ** 2))))
        wrong = check.rms_error_g > LARGEST_TURN_RESIDUAL
    if wrong:
        raise InputError(
            f"|a| is {size.mean():.2f} +- {np.std(size):.2f} g with what the extremes say: no slow turn through 360 "
            "degrees about two axes"
        )
    limits = [
        "how near an axis came to the vertical: 3 degrees off makes its scale 0.14 % too small",
        "angles between the axes (--method poses)",
    ]
    if len(raw) < FEW_TURN_SAMPLES:
        limits.append(f"what {len(raw)} readings pass by: below {FEW_TURN_SAMPLES} the intervals are too narrow")
    if missing:
        named = ", ".join("xyz"[i] for i in range(3) if i not in axes)
        limits.insert(0, f"bias and scale of {named}, and |a|: see missing")
    design = np.kron(np.eye(len(axes)), [[1.0, 1.0], [1.0, -1.0]]).astype(
        np.float64
    )  # reading up and down = bias +- scale
    noise = float(np.max(scatter[axes])) / np.sqrt(2.0)
    return _exact("turn", parameters, design, len(raw), noise, missing, limits=tuple(limits), check=check)


def _runs(here: NDArray[np.bool_], bridge: int = 0) -> list[tuple[int, int]]:
    """Return (start, stop) of the runs of True; gaps of fewer than ``bridge`` samples are closed."""
    edges = np.flatnonzero(np.diff(np.concatenate([[False], here, [False]]).astype(np.int8))).reshape(-1, 2)
    runs: list[tuple[int, int]] = []
    for start, stop in edges.tolist():
        if runs and start - runs[-1][1] < bridge:
            runs[-1] = (runs[-1][0], stop)
        else:
            runs.append((start, stop))
    return runs


def find_fall(force_g: Array, rate_hz: float) -> tuple[int, int] | None:
    """Return the samples (first, last + 1) of the longest free fall of at least 50 ms in readings (n, 3), or None.

    A fall is searched where |a| is below half of 1 g. It is what stays within 0.1 g of the quietest 50 ms there: the
    resistance of a liquid, a rope or the air that grows afterwards ends it. A rebound of less than 5 ms (what held the
    sensor lets go with a jerk) does not.
    """
    shortest = max(3, round(SHORTEST_FALL_S * rate_hz))
    best: tuple[int, int] | None = None
    for start, stop in _runs(np.linalg.norm(force_g, axis=1) < FALL_G):
        if stop - start < shortest:
            continue
        quiet = start + int(np.argmin(spread(force_g[start:stop], shortest)))
        around = force_g[max(start, quiet - shortest // 2) : quiet + shortest // 2 + 1]
        off = np.linalg.norm(force_g - np.median(around, axis=0), axis=1)
        for run in _runs(off < NEAR_G, max(1, round(BOUNCE_S * rate_hz))):
            longest = shortest if best is None else best[1] - best[0] + 1
            if run[0] <= quiet < run[1] and run[1] - run[0] >= longest:
                best = run
    return best


def inside_fall(fall: tuple[int, int]) -> slice:
    """Return the samples of a fall without a tenth at either end."""
    margin = round(EDGE_SHARE * (fall[1] - fall[0]))
    return slice(fall[0] + margin, fall[1] - margin)


def free_fall(raw: Array, rate_hz: float, counts_per_g: float) -> QuickResult:
    """Return the offset of every axis (n, 3) in free fall, ends left out."""
    fall = find_fall(raw / counts_per_g, rate_hz)
    if fall is None:
        raise InputError(f"no free fall: |a| never stays below {FALL_G:g} g for {1e3 * SHORTEST_FALL_S:.0f} ms")
    missing = ["x up or down", "y up or down", "z up or down"]
    if fall[0] == 0:
        missing.append("the rest before the fall")
    part = raw[inside_fall(fall)]
    if len(part) < 16:
        raise InputError(f"the longest fall has {len(part)} samples without its ends; 16 are needed: drop from higher")
    if len(part) / rate_hz > LONGEST_FALL_S:
        raise InputError(
            f"|a| is below {FALL_G:g} g for {len(part) / rate_hz:.1f} s: that is no fall; check --counts-per-g"
        )
    limits = ("scale: 0 g does not show it", "drag of the air and tumbling: they look like bias")
    return _exact(
        "fall", _one_pose(part), np.eye(3), len(part), float(part.std(axis=0).max()), tuple(missing), limits=limits
    )


def flat(raw: Array, counts_per_g: float, up: str) -> QuickResult:
    """Return the offset of a sensor that lies flat with axis ``up`` ("x", "-z", ...) up: its 1 g is subtracted (erratum
    115)."""
    axis = "xyz".find(up[-1:]) if up else -1
    if axis < 0 or up[:-1] not in ("", "-", "+"):
        raise InputError(f"up = '{up}': name an axis, as z or -z")
    if len(raw) < 32:
        raise InputError(f"{len(raw)} samples: 32 are needed")
    direction = np.zeros(3)
    direction[axis] = -1.0 if up[0] == "-" else 1.0
    part = raw - counts_per_g * direction
    noise = float(part.std(axis=0).max())
    if noise / counts_per_g > LARGEST_FLAT_SPREAD_G:
        raise InputError(f"the readings spread by {noise / counts_per_g:.2g} g: it moves; let it lie still")
    off = part.mean(axis=0) / counts_per_g
    worst = int(np.argmax(np.abs(off)))
    if abs(off[worst]) > LARGEST_FLAT_BIAS_G:
        raise InputError(
            f"axis {'xyz'[worst]} would have an offset of {off[worst]:.2f} g: is {up} the axis that points up, and are "
            f"{counts_per_g:g} counts one g?"
        )
    level = " and ".join(name for i, name in enumerate("xyz") if i != axis)
    limits = (
        f"tilt of the surface: 1 degree looks like a bias of {np.sin(np.radians(1.0)) * counts_per_g:.3g} in {level}",
        f"scale: 1 % of it looks like a bias of {0.01 * counts_per_g:.3g} in {'xyz'[axis]}",
    )
    return _exact(
        "flat", _one_pose(part), np.eye(3), len(part), noise, missing_poses(direction[None, :]), limits=limits
    )
