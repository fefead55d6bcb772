"""Compares the distance of a recording's samples with the time constants that its twin states.

A time column in ms that is read as seconds puts the samples a thousand times too far apart: the twin is then at rest
between any two of them.
"""

from __future__ import annotations

from collections.abc import Mapping
from types import MappingProxyType

import numpy as np

from hal.trust import NotTrusted
from tools.errors import RecordingError
from tools.mismatch.guess_roles import split_clock
from tools.mismatch.recording import Array, Recording

FAR_APART = 2.0
"""Distance of two samples, in slowest time constants of the twin, from which on the time column is doubted."""
INTEGRATES = 1e-9
"""Largest pole of an integrator, relative to the fastest pole."""


def pace_note(recording: Recording, time_column: str) -> str:
    """Return a note if even the twin's slowest time constant is shorter than a sample, else an empty text."""
    rates = _rates_per_s(recording)
    rates = rates[rates > INTEGRATES * np.max(rates, initial=0.0)]
    if rates.size == 0 or recording.dt * rates.min() < FAR_APART:
        return ""
    slowest_s = 1.0 / float(rates.min())
    found = (
        f"by column '{time_column}' the samples are {recording.dt:.3g} s apart; the twin's slowest time constant"
        f" ({slowest_s:.2g} s) is {recording.dt / slowest_s:.2g} times shorter"
    )
    if split_clock(time_column)[1]:  # its name states the unit
        return f"{found}; check the units of the twin's time constants"
    return f"{found}. If the column is in ms, write rate_hz = {1e3 / recording.dt:.6g} in place of time_column"


def _rates_per_s(recording: Recording) -> Array:
    """Return the absolute values of the twin's poles as given, 1/s; none where it states none or cannot be built."""
    given = recording.twin.parameters
    match recording.twin.kind:
        case "mechanical_axis":
            mass, damping, stiffness = (_number(given.get(k, d)) for k, d in _AXIS.items())
            return _moduli([[0.0, 1.0], [-stiffness / mass, -damping / mass]]) if mass > 0.0 else np.zeros(0)
        case "state_space" if not given.get("discrete"):
            return _moduli(given.get("A"))
        case "ode":
            from tools.mismatch.twins.ode_text import ode_twin

            try:
                twin = ode_twin(recording)
            except (RecordingError, NotTrusted):  # a later step reports the fault
                return np.zeros(0)
            return _moduli(twin.linearised(twin.start_values).a) if twin.has_states else np.zeros(0)
        case _:
            return np.zeros(0)


_AXIS: Mapping[str, object] = MappingProxyType({"mass": None, "damping": None, "stiffness": 0.0})


def _number(value: object) -> float:
    return float(value) if isinstance(value, int | float) else float("nan")


def _moduli(matrix: object) -> Array:
    """Return the absolute eigenvalues of a square matrix of finite numbers; none of anything else."""
    try:
        a = np.asarray(matrix, np.float64)
        return np.abs(np.linalg.eigvals(a)) if np.all(np.isfinite(a)) else np.zeros(0)
    except (TypeError, ValueError, np.linalg.LinAlgError):
        return np.zeros(0)
