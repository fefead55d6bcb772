"""Writes the poles and the static gains of a ``state_space`` as text, in the units of the recording.

A matrix in a wrong unit, or a row in a wrong place, shows in them at once.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from hal.arrays import Array, ComplexArray
from tools.errors import RecordingError
from tools.mismatch import units
from tools.mismatch.recording import Recording
from tools.mismatch.recording_pace import INTEGRATES
from tools.mismatch.twins.state_space import Matrices, read_matrices

SLOW = 1e-6
"""Rate at which a gain beside an integrator is read, in rates of the slowest other pole: its error is as small."""
GROWS = 3.0
"""Growth of a gain at a tenth of that rate from which on it integrates; an integrator makes it 10, a finite gain 1."""


def linear_lines(recording: Recording) -> list[str]:
    """Return a line of the poles and a line of the static gains of a ``state_space``; none of another kind.

    A filter in front (``first``) is not in the matrices: there are no lines then. A fault of the matrices is reported
    where the twin is built.
    """
    if recording.twin.kind != "state_space" or "first" in recording.twin.parameters:
        return []
    try:
        m = read_matrices(recording)
    except RecordingError:
        return []
    poles = _poles_per_s(m, recording.dt)
    gains, integrates = _static_gains(m, poles, recording.dt)
    texts: list[str] = []
    for k, o in enumerate(recording.outputs):
        for i, u in enumerate(recording.inputs):
            own, of = recording.file_unit[o], recording.file_unit[u]
            factor = units.convert_difference(1.0, recording.unit[o], own)
            factor /= units.convert_difference(1.0, recording.unit[u], of)
            text = "integrates" if integrates[k, i] else f"{factor * gains[k, i]:.4g} {own} per {of}"
            texts.append(f"{u} to {o} {text}")
    return [f"poles: {', '.join(_pole_texts(poles)) or 'none'}", f"static gain: {', '.join(texts)}"]


def _poles_per_s(m: Matrices, dt: float) -> ComplexArray:
    """Return the poles in 1/s, the slowest first; a pole of a difference equation at zero, a pure delay, has none."""
    poles = np.asarray(np.linalg.eigvals(m.a), np.complex128)
    if m.discrete:
        poles = np.asarray(np.log(poles[np.abs(poles) > INTEGRATES]) / dt, np.complex128)
    return poles[np.argsort(np.abs(poles), kind="stable")]


def _pole_texts(poles: ComplexArray) -> list[str]:
    """Return each real pole in 1/s and each pair by its frequency and damping ratio."""
    texts: list[str] = []
    fastest = float(np.max(np.abs(poles), initial=0.0))
    for p in poles.tolist():
        size = abs(p)
        if size <= INTEGRATES * fastest or size == 0.0:
            texts.append("0 1/s")
        elif abs(p.imag) <= INTEGRATES * size:
            texts.append(f"{p.real:.4g} 1/s")
        elif p.imag > 0.0:
            texts.append(f"{size / (2 * np.pi):.4g} Hz with damping {-p.real / size:.3g}")
    return texts


def _static_gains(m: Matrices, poles: ComplexArray, dt: float) -> tuple[Array, NDArray[np.bool_]]:
    """Return the gains at rest (outputs, inputs) and the mask of those that grow without bound."""
    sizes = np.abs(poles)
    moving = sizes[sizes > INTEGRATES * np.max(sizes, initial=0.0)]
    if moving.size == sizes.size:
        return _gains(m, 0.0, dt), np.zeros(m.d.shape, np.bool_)
    rate = SLOW * (float(moving.min()) if moving.size else 1.0 / dt)
    near, nearer = _gains(m, rate, dt), _gains(m, 0.1 * rate, dt)
    return near, np.abs(nearer) > GROWS * np.abs(near)


def _gains(m: Matrices, rate: float, dt: float) -> Array:
    """Return the transfer matrix at the real rate ``rate`` in 1/s."""
    s = np.exp(rate * dt) if m.discrete else rate
    return m.c @ np.linalg.solve(s * np.eye(m.a.shape[0]) - m.a, m.b) + m.d
