"""Checks a recording before a diagnosis: right signal, sign, unit, and completeness."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import linear_sum_assignment
from scipy.signal import correlate

from tools.mismatch.engine.noise import lattice_step

Array = NDArray[np.float64]

FACTORS = {
    1e3: "a factor 1000 (milli or kilo)",
    1e-3: "a factor 1000 (milli or kilo)",
    1e6: "a factor 1e6 (micro)",
    1e-6: "a factor 1e6 (micro)",
    9.80665: "standard gravity (g or m/s^2)",
    1 / 9.80665: "standard gravity (g or m/s^2)",
    180 / np.pi: "degrees or radians",
    np.pi / 180: "degrees or radians",
}


def constant_channels(signals: Mapping[str, Array]) -> list[str]:
    """Return the names of channels that never move."""
    return [s for s, x in signals.items() if float(np.ptp(x)) == 0.0]


def clipped_samples(y: Array) -> tuple[int, int]:
    """Return the number of samples in runs of three or more at the exact lowest and highest value."""

    def runs(level: float) -> int:
        at = np.concatenate(([0], (y == level).astype(int), [0]))
        edges = np.diff(at)
        lengths = np.nonzero(edges == -1)[0] - np.nonzero(edges == 1)[0]
        return int(lengths[lengths >= 3].sum())

    return (0, 0) if np.ptp(y) == 0 else (runs(float(y.min())), runs(float(y.max())))


def repeated_samples(y: Array) -> int:
    """Count the samples that equal the previous one although the channel has fine steps: a logger held its value."""
    same = int(np.sum(np.diff(y) == 0))
    if lattice_step(y) > 0 or np.unique(y).size < 0.5 * y.size:
        return 0
    return same


def lag_samples(y: Array, x: Array, most: int) -> int:
    """Return the shift of ``y`` against ``x`` (n,) in samples with the best correlation; positive: ``y`` is late."""
    a, b = y - y.mean(), x - x.mean()
    if not np.any(a) or not np.any(b):
        return 0
    c = correlate(a, b, mode="full", method="fft")
    middle = a.size - 1
    shifts = np.arange(-most, most + 1)
    window = c[middle - most : middle + most + 1] / (a.size - np.abs(shifts))
    return int(np.argmax(np.abs(window))) - most


def gross_scale(y: Array, simulated: Array) -> tuple[float, float]:
    """Return (slope, correlation) of a recorded output against the simulation as given."""
    a, b = y - y.mean(), simulated - simulated.mean()
    power, both = float(b @ b), float(a @ b)
    size = float(np.sqrt((a @ a) * power))
    return (both / power if power > 0 else np.nan), (both / size if size > 0 else 0.0)


def messages(
    inputs: Mapping[str, Array],
    outputs: Mapping[str, Array],
    context: Mapping[str, Array],
    simulated: Mapping[str, Array],
    drives: Mapping[str, str],
    dt: float,
) -> list[str]:
    """Return messages on faults of the recording that are not physics. ``simulated``: the twin as given (n,)."""
    out: list[str] = []
    for s in constant_channels({**inputs, **outputs, **context}):
        out.append(f"{s} never changes: is it connected?")
    for o, y in outputs.items():
        low, high = clipped_samples(y)
        if lattice_step(y) == 0 and low + high > max(5, 0.001 * y.size):
            out.append(f"{o} sits at its exact limits in {low + high} samples")
        held = repeated_samples(y)
        if held > max(3, 0.002 * y.size):
            out.append(f"{o} repeats its last value {held} times: a logger that lost samples?")
        slope, rho = gross_scale(y, simulated[o])
        if abs(rho) < 0.7 or not np.isfinite(slope):
            shift = lag_samples(y, simulated[o], min(y.size // 4, round(2.0 / dt) + 10))
            if abs(rho) < 0.5 and shift != 0:
                out.append(f"{o} matches the simulation best {shift * dt:.4g} s late: do both clocks start together?")
            continue
        if slope < 0:
            out.append(f"{o} has the opposite sign of the simulation")
        for factor, words in FACTORS.items():
            if abs(abs(slope) / factor - 1) < 0.06:
                out.append(f"{o} is {abs(slope):.4g} times the simulation: {words}?")
                break
    if len(outputs) > 1 and all(drives.get(o) in inputs for o in outputs):
        names, sources = list(outputs), [drives[o] for o in outputs]
        if len(set(sources)) == len(sources):
            rho = np.array([[abs(gross_scale(outputs[o], inputs[s])[1]) for s in sources] for o in names])
            rho = np.nan_to_num(rho)
            rows, columns = linear_sum_assignment(-rho)
            moved = [(i, j) for i, j in zip(rows, columns, strict=True) if i != j and rho[i, j] > rho[i, i] + 0.5]
            if moved:
                pairs = ", ".join(f"{names[i]} follows {sources[j]}" for i, j in moved)
                out.append(f"axes look swapped: {pairs}")
    return out
