"""Infers the units of a twin of matrices or equations from the recording where the twin does not state them.

By the contract a channel in mV is converted to V. A user who identified A, B, C from a table in mV, however, has C in
mV. Both happen, and a factor of a thousand is no physics: per signal, the unit (SI, or as declared) is chosen under
which the twin as given moves as much as the recording does. In doubt it is SI for matrices. Equations state the units
of their states, and may state those of inputs and outputs under ``units``: a channel is converted to what is stated.
The others stay as declared in doubt.
"""

from __future__ import annotations

import itertools
from collections.abc import Mapping
from dataclasses import replace

import numpy as np

from hal.trust import NotTrusted
from tools.errors import RecordingError
from tools.mismatch import units
from tools.mismatch.recording import Recording

SI = ("V", "m", "rad", "N", "N m", "A", "T", "m/s", "m/s^2", "rad/s", "rad/s^2", "Pa", "s", "Hz", "W", "ohm")
MOST_INPUTS = 4  # largest number of inputs with a choice; more are read as SI
CLEAR = 1.1  # natural logarithm of the factor by which the amplitude must match better than with the usual choice


def si_unit(unit: str) -> str:
    """Return the SI unit of the dimension of ``unit``, or ``unit`` itself if it is SI or has no plain SI name."""
    parsed = units.parse(unit)
    if parsed.offset or parsed.dimension == units.parse("1").dimension:
        return unit
    found = next((u for u in SI if units.parse(u).dimension == parsed.dimension), unit)
    return unit if units.parse(found).factor == parsed.factor else found


def read_in(recording: Recording, to: dict[str, str]) -> Recording:
    """Return the recording with these signals in other units of their dimension."""
    if not to:
        return recording

    def moved(signals: dict[str, np.ndarray]) -> dict[str, np.ndarray]:
        return {s: units.convert(x, recording.unit[s], to.get(s, recording.unit[s])) for s, x in signals.items()}

    def size(s: str, v: float) -> float:
        return units.convert_difference(v, recording.unit[s], to.get(s, recording.unit[s]))

    return replace(
        recording,
        inputs=moved(dict(recording.inputs)),
        outputs=moved(dict(recording.outputs)),
        noise={s: None if v is None else size(s, v) for s, v in recording.noise.items()},
        input_noise={s: size(s, v) for s, v in recording.input_noise.items()},
        declared_step={s: size(s, v) for s, v in recording.declared_step.items()},
        tolerance={s: size(s, v) for s, v in recording.tolerance.items()},
        unit={s: to.get(s, u) for s, u in recording.unit.items()},
    )


@np.errstate(over="ignore", invalid="ignore")  # of a twin that diverges
def in_twin_units(recording: Recording) -> Recording:
    """Return the recording in the units of its twin of matrices or equations, with a note on the choice.

    If the twin cannot be built, the recording is returned unchanged; a later step reports the fault. Raises
    RecordingError where a channel is not of the dimension that the twin states.
    """
    stated = _stated_units(recording) if recording.twin.kind == "ode" else {}
    recording = read_in(recording, stated)
    choice = {s: si_unit(recording.unit[s]) for s in (*recording.inputs, *recording.outputs) if s not in stated}
    choice = {s: u for s, u in choice.items() if u != recording.unit[s]}
    if not choice:
        return recording
    in_si = recording.twin.kind == "state_space"  # what is taken where both are possible
    free = [s for s in recording.inputs if s in choice]
    ways = [(in_si,) * len(free)] if len(free) > MOST_INPUTS else itertools.product((True, False), repeat=len(free))
    best: tuple[float, dict[str, str]] | None = None
    for way in ways:
        to = {s: choice[s] for s, si in zip(free, way, strict=True) if si}
        try:
            moved = read_in(recording, to)
            ratio = _amplitude_ratios(moved)
        except (RecordingError, NotTrusted, np.linalg.LinAlgError):
            return recording
        cost = 0.0 if all(si == in_si for si in way) else CLEAR
        for o, r in ratio.items():
            off = abs(np.log(r))
            if o in choice:
                factor = units.convert_difference(1.0, recording.unit[o], choice[o])
                off_in_si = abs(np.log(r / factor))
                if off_in_si + CLEAR < off or (in_si and off_in_si <= off + CLEAR):
                    to[o] = choice[o]
                    off = off_in_si
            cost += off
        if best is None or cost < best[0]:
            best = (cost, to)
    assert best is not None
    notes = recording.warnings
    kept = [f"{s} in {recording.unit[s]}" for s in choice if s not in best[1]]
    if in_si and kept:
        notes = (*notes, f"the twin's matrices fit {', '.join(kept)}: these units are kept and not made SI")
    elif best[1] and not in_si:
        made = ", ".join(f"{s} in {u}" for s, u in best[1].items())
        notes = (*notes, f"the twin's equations fit {made}: converted; [twin.units] may state the unit of a signal")
    return replace(read_in(recording, best[1]), warnings=notes)


def _stated_units(recording: Recording) -> dict[str, str]:
    """Return the unit of each input and output whose unit the equations state; malformed entries are left out."""
    table = recording.twin.parameters
    states, own, read = (_table(table.get(k)) for k in ("states", "units", "outputs"))
    stated: dict[str, str] = {}
    for signal in (*recording.inputs, *recording.outputs):
        unit, where = own.get(signal), "units"
        if unit is None and signal in recording.outputs and signal not in read:
            state = states.get(signal)
            unit, where = (state.get("unit") if isinstance(state, Mapping) else state), "states"
        if not isinstance(unit, str) or unit.strip() in ("", "-", "1"):
            continue
        try:
            fits = units.same_dimension(unit, recording.unit[signal])
        except units.UnitError:
            continue
        if not fits:
            raise RecordingError(
                f"{recording.path}: signal '{signal}' is recorded in {recording.unit[signal] or '1'}, and"
                f" [twin.{where}] states {unit}; correct one of the two"
            )
        stated[signal] = unit
    return stated


def _table(value: object) -> Mapping[str, object]:
    return {str(k): v for k, v in value.items()} if isinstance(value, Mapping) else {}


def _amplitude_ratios(recording: Recording) -> dict[str, float]:
    """Return the spread of the twin as given over that of the recording, per output."""
    from tools.mismatch.simulate import Model
    from tools.mismatch.simulate_view import View
    from tools.mismatch.twins.make import make

    model = Model(make(recording))
    with np.errstate(all="ignore"):
        simulated = model.simulate(View.whole(recording), model.start(recording))
    out: dict[str, float] = {}
    for o, y in simulated.items():
        spread = float(np.std(y))
        out[o] = max(spread, 1e-300) / float(np.std(recording.outputs[o])) if np.isfinite(spread) else 1e300
    return out
