"""Writes a state space with physical states as differential equations, so that forces reach each state."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import Any

from sim_devices.physics.effect import Array
from tools.errors import RecordingError
from tools.mismatch.recording import Recording
from tools.mismatch.twins.holds import holds_text
from tools.mismatch.twins.ode import OdeTwin
from tools.mismatch.twins.ode_text import ode_twin, offset_name
from tools.mismatch.twins.state_space import Matrices

STRUCTURE = (0.0, 1.0, -1.0)
"""Entries that express structure (a position is the integral of a velocity) and are not re-fitted."""


def physical_twin(recording: Recording, m: Matrices) -> OdeTwin:
    """Build the twin of matrices with named ``states``. All entries of A, B and y0 but ``STRUCTURE`` may be re-fitted.

    Raises RecordingError for a discrete model and for states that do not match A.
    """
    where = f"{recording.path}: [twin.parameters]"
    if m.discrete:
        raise RecordingError(f"{where} states have names in continuous time only; leave out states or discrete = true")
    table = recording.twin.parameters["states"]
    if not isinstance(table, Mapping) or len(table) != m.a.shape[0]:
        raise RecordingError(f"{where} states must name each of the {m.a.shape[0]} rows of A with its unit")
    names = [str(n) for n in table]
    states: dict[str, dict[str, Any]] = {}
    for n, entry, x0 in zip(names, table.values(), m.x0.tolist(), strict=True):
        states[n] = {"unit": entry, "start": x0} if isinstance(entry, str) else {"start": x0, **dict(entry)}
    numbers: dict[str, float] = {}
    at: dict[str, tuple[str, int, int]] = {}

    def terms(matrix: str, row: int, values: Array, of: list[str]) -> list[str]:
        out: list[str] = []
        for j, v in enumerate(values.tolist()):
            if v in STRUCTURE or matrix in ("C", "D"):
                out += [f"({v!r})*{of[j]}"] if v else []
            else:
                name = f"{matrix}_{row + 1}_{j + 1}"
                numbers[name], at[name] = v, (matrix, row, j)
                out.append(f"{name}*{of[j]}")
        return out

    inputs, outputs = list(recording.inputs), list(recording.outputs)
    equations = {
        n: " + ".join([*terms("A", i, m.a[i], names), *terms("B", i, m.b[i], inputs)]) or "0"
        for i, n in enumerate(names)
    }
    readings: dict[str, str] = {}
    for k, o in enumerate(outputs):
        parts = [*terms("C", k, m.c[k], names), *terms("D", k, m.d[k], inputs)]
        at[offset_name(o)] = ("y0", k, 0)
        readings[o] = " + ".join(parts) or "0"
    text = {**numbers, "states": states, "equations": equations, "outputs": readings, "hold": holds_text(m.holds)}
    text["offsets"] = dict(zip(outputs, m.y0.tolist(), strict=True))
    given = recording.twin.parameters
    twin = ode_twin(replace(recording, twin=replace(recording.twin, parameters=text)))

    def text_of(found: Mapping[str, float]) -> dict[str, object]:
        now = {"A": m.a.copy(), "B": m.b.copy(), "y0": m.y0[:, None].copy()}
        for name, v in found.items():
            matrix, i, j = at[name]
            now[matrix][i, j] = v
        return {**given, **{k: v.tolist() for k, v in now.items()}}

    return replace(twin, text_of=text_of)
