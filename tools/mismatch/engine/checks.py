"""Checks a recording before a diagnosis: right signal, sign, unit, and completeness."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from scipy.optimize import linear_sum_assignment
from scipy.signal import correlate

from hal.arrays import Array
from tools.mismatch.engine.noise import lattice_step
from tools.mismatch.recording import Recording
from tools.mismatch.simulate import Model
from tools.mismatch.simulate_view import View
from tools.mismatch.twins.fmu import with_equations
from tools.mismatch.twins.make import make
from tools.mismatch.units import sizes_beside

ALIKE = 1.06
"""Factor within which the slope of an output that follows its simulation counts as that of a unit."""
APART, NEAR = 5.0, 1.5
"""Least ratio of the spreads of an output and a simulation that it does not follow above which a unit may be wrong, and
the factor within which it counts as that of a unit. Wrong parameters change a spread by less."""


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
    """Count the samples that equal the previous one although the channel has fine steps: a logger held its value.

    Rounding makes at most as many equal neighbours as neighbours one step apart; these are taken off.
    """
    moves = np.abs(np.diff(y))
    if lattice_step(y) > 0 or np.unique(y).size < 0.5 * y.size or not np.any(moves):
        return 0
    step = float(moves[moves > 0].min())
    others = int(np.sum((moves > 0) & (moves < 1.5 * step))) - 1  # beside the move that defines the step
    return max(int(np.sum(moves == 0)) - others, 0)


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


def likely_unit(unit: str, ratio: float, within: float) -> str:
    """Return what a column in ``unit`` would be in if its values are ``ratio`` times too large, "" without an answer.

    ``within``: factor by which the ratio may differ from that of the two units.
    """
    found, least = "", within
    for other, factor in sizes_beside(unit):
        off = max(ratio / factor, factor / ratio) if ratio > 0 else np.inf
        if max(factor, 1 / factor) > ALIKE * ALIKE and off < least:
            found, least = other, off
    return f"is the column in {found}, not in {unit}" if unit and found else found


def messages(
    inputs: Mapping[str, Array],
    outputs: Mapping[str, Array],
    context: Mapping[str, Array],
    simulated: Mapping[str, Array],
    drives: Mapping[str, str],
    dt: float,
    *,
    units: Mapping[str, str] | None = None,
) -> list[str]:
    """Return messages on faults of the recording that are not physics. ``simulated``: the twin as given (n,).

    ``units``: the unit of each output in its file.
    """
    units = units or {}
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
            still = float(np.std(simulated[o]))
            ratio = float(np.std(y)) / still if still > 0 and np.isfinite(still) else 1.0
            unit = likely_unit(units.get(o, ""), ratio, NEAR) if max(ratio, 1 / max(ratio, 1e-300)) > APART else ""
            if unit:
                out.append(f"{o} spreads {ratio:.3g} times as far as the simulation: {unit}?")
            shift = lag_samples(y, simulated[o], min(y.size // 4, round(2.0 / dt) + 10))
            if abs(rho) < 0.5 and shift != 0:
                out.append(f"{o} matches the simulation best {shift * dt:.4g} s late: do both clocks start together?")
            continue
        if slope < 0:
            out.append(f"{o} has the opposite sign of the simulation")
        if unit := likely_unit(units.get(o, ""), abs(slope), ALIKE):
            out.append(f"{o} is {abs(slope):.4g} times the simulation: {unit}?")
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


def first_look(recording: Recording, model: Model, theta: Array) -> list[str]:
    """Return the messages of ``messages`` on a recording beside the simulation at ``theta``."""
    r, twin = recording, model.twin
    with np.errstate(all="ignore"):
        simulated = model.simulate(View.whole(r), theta)
    drives = {o: twin.drive(o) for o in twin.outputs}
    return messages(r.inputs, r.outputs, r.context, simulated, drives, r.dt, units=r.file_unit)


def questions(recording: Recording) -> list[str]:
    """Return the messages on a recording beside its twin as given, before a search that may take minutes.

    Raises RecordingError if the twin cannot be made.
    """
    recording = with_equations(recording)
    model = Model(make(recording))
    return first_look(recording, model, model.start(recording))
