"""Checks that a recording contains what a stack's model needs."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from hal.arrays import Array


def determined_from(drive: Array) -> int:
    """First sample at which the plays no longer depend on what came before the recording: the drive has been at
    its lowest and at its highest by then (the larger swing wipes out the memory of the smaller)."""
    span = np.ptp(drive)
    low = int(np.argmax(drive <= drive.min() + 0.01 * span))
    high = int(np.argmax(drive >= drive.max() - 0.01 * span))
    return max(low, high)


def swings_V(drive: Array) -> Array:
    """Return the size of each half cycle (k,), in V."""
    steps = np.diff(drive)
    moving = steps[steps != 0.0]
    turns = np.flatnonzero(np.diff(np.sign(moving)) != 0)
    at = drive[1:][steps != 0.0][turns]
    return np.abs(np.diff(at))


def one_loop(drives: Sequence[Array]) -> bool:
    """Return True if a single recording (n,) holds loops of one size only."""
    sizes = swings_V(drives[0])
    return len(drives) == 1 and len(sizes) > 3 and bool(np.quantile(sizes, 0.9) < 1.5 * np.quantile(sizes, 0.1))


def missing(drives: Sequence[Array], rates_um_s: Sequence[Array], seconds: Sequence[float]) -> list[str]:
    """Return the parts that the excitation ``drive`` (n,) in V lacks: range, small loops, reversals, rates of a tremor,
    rest."""
    span = max(d.max() for d in drives) - min(d.min() for d in drives)
    swings = np.concatenate([swings_V(d) for d in drives])
    top = max(float(np.quantile(r, 0.995)) for r in rates_um_s)
    low = min(float(np.quantile(r, 0.1)) for r in rates_um_s)
    problems: list[str] = []
    if span < 80.0:
        problems.append(f"the drive covers {span:.0f} V; beyond that the model is a guess: record 0 to 100 V")
    if len(swings) == 0 or np.min(swings) > 0.15 * span:
        problems.append("no small loops: add sinusoids of a few volts, where a tremor is cancelled")
    if len(swings) < 10:
        problems.append(f"only {len(swings) + 1} reversals: record more cycles of different size")
    if top < 700.0:
        problems.append(
            f"the fastest motion is {top:.0f} um/s; 12.5 um p-p at 19 Hz reaches 746: add saw-teeth up to 40 Hz"
        )
    if low > 20.0:
        problems.append(
            f"nothing slower than {low:.0f} um/s: add a saw-tooth of 0.1 to 0.5 Hz for slopes at rest and creep"
        )
    if max(seconds) < 10.0:
        problems.append(f"the longest recording lasts {max(seconds):.0f} s: creep beyond that is not seen")
    return problems
