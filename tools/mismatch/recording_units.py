"""Infers the units of a state-space twin from the recording, because its matrices do not state them.

By the contract a channel in mV is converted to V. A user who identified A, B, C from a table in mV, however, has C in
mV. Both happen, and a factor of a thousand is no physics: per signal, the unit (SI, or as declared) is chosen under
which the twin as given moves as much as the recording does.
"""

from __future__ import annotations

import itertools
from dataclasses import replace

import numpy as np

from tools.errors import RecordingError
from tools.mismatch import units
from tools.mismatch.recording import Recording

SI = ("V", "m", "rad", "N", "N m", "A", "T", "m/s", "m/s^2", "rad/s", "rad/s^2", "Pa", "s", "Hz", "W", "ohm")
MOST_INPUTS = 4  # largest number of inputs with a choice; more are read as SI
CLEAR = 1.1  # natural logarithm of the factor by which "as declared" must match the amplitude better


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


def in_twin_units(recording: Recording) -> Recording:
    """Return the recording in the units of its state-space twin, with a note on the choice.

    If the twin cannot be built, the recording is returned unchanged; a later step reports the fault.
    """
    choice = {s: si_unit(recording.unit[s]) for s in (*recording.inputs, *recording.outputs)}
    choice = {s: u for s, u in choice.items() if u != recording.unit[s]}
    if not choice:
        return recording
    free = [s for s in recording.inputs if s in choice]
    ways = [(True,) * len(free)] if len(free) > MOST_INPUTS else itertools.product((True, False), repeat=len(free))
    best: tuple[float, dict[str, str]] | None = None
    for way in ways:
        to = {s: choice[s] for s, si in zip(free, way, strict=True) if si}
        try:
            moved = read_in(recording, to)
            ratio = _amplitude_ratios(moved)
        except RecordingError:
            return recording
        cost = 0.0 if all(way) else CLEAR
        for o, r in ratio.items():
            as_declared = abs(np.log(r))
            if o in choice:
                factor = units.convert_difference(1.0, recording.unit[o], choice[o])
                in_si = abs(np.log(r / factor))
                if in_si <= as_declared + CLEAR:
                    to[o] = choice[o]
                    as_declared = in_si
            cost += as_declared
        if best is None or cost < best[0]:
            best = (cost, to)
    assert best is not None
    kept = [f"{s} in {recording.unit[s]}" for s in choice if s not in best[1]]
    notes = recording.warnings
    if kept:
        notes = (*notes, f"the twin's matrices fit {', '.join(kept)}: these units are kept and not made SI")
    return replace(read_in(recording, best[1]), warnings=notes)


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
