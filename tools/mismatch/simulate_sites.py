"""Lists the places of an effect in a chain; places that a recording cannot distinguish are one place with a note."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace

from sim_devices.physics.effect import STAGES, Effect, Stage
from tools.mismatch.placed import Placed
from tools.mismatch.recording import Recording
from tools.mismatch.twins.base import Twin
from tools.mismatch.twins.cascade import BETWEEN, between_of
from tools.mismatch.twins.ode_inside import Place
from tools.mismatch.twins.opaque import OpaqueTwin

SAME = "input or output"
AXIS = Place("", "motion", 0, 1, 1, "")
_WHOLE_RECORD = ("dead_time", "clock_skew", "dropped_samples")  # one clock for all outputs
_ALIKE = ("first_order_lag",)  # equal channels of one instrument, or one filter in front of them
_DRIVES: tuple[Stage, ...] = ("amplifier", "actuator")  # stages before the base physics


def sites(twin: Twin, recording: Recording, effect: Effect, present: Sequence[Placed] = ()) -> list[Placed]:
    """Return places for ``effect``, most likely first; empty if this twin or recording cannot have it (``why_not``).

    ``present``: effects that are already placed; behind a nonlinear one, input and output are different places.
    """
    out: list[Placed] = []
    for one in (effect, *effect.variants):
        out += [p for p in _sites(twin, recording, one, present) if _unit_fits(twin, p)]
    return out


def _unit_fits(twin: Twin, place: Placed) -> bool:
    """Return True if the effect may act on the unit of the signal at its place, where that is an end of the chain."""
    return place.site == "feedback" or place.target == BETWEEN or _unit_fits_at(twin, place.effect)(place.target)


def _unit_fits_at(twin: Twin, effect: Effect) -> Callable[[str], bool]:
    return lambda signal: not effect.end_units or twin.units.get(signal, "") in effect.end_units


def why_not(twin: Twin, recording: Recording, effect: Effect) -> str:
    """Return in words why an effect cannot be proposed here at all; "" if it can."""
    reasons = [_why_not(twin, recording, one) for one in (effect, *effect.variants)]
    return "" if "" in reasons else reasons[0]


def _why_not(twin: Twin, recording: Recording, effect: Effect) -> str:
    if effect.twins and twin.kind not in effect.twins:
        return f"not in a {twin.kind}"
    if not set(effect.stages) & set(twin.chain):
        return f"no {' or '.join(effect.stages)} in the chain of this twin"
    if effect.shifts_line and _commutes(twin):
        return "gain and zero of this twin are re-fitted"
    if effect.kind == "feedback" and not twin.feedback_on:
        return "the twin has no equation of motion"
    if effect.kind == "feedback" and not _acts_at(twin, effect):
        return f"no {' or '.join(effect.position_units) or 'state'} that it could act on"
    if effect.sites == ("between",) and not between_of(twin):
        return "no place between two filters"
    if effect.end_units and not between_of(twin) and not any(map(_unit_fits_at(twin, effect), twin.units)):
        return f"no signal in {' or '.join(effect.end_units)}, and no place between two filters"
    missing = [s for s in effect.needs if s not in recording.signals]
    if missing:
        return f"{', '.join(missing)} not recorded"
    if effect.name == "channel_delay" and len(twin.outputs) < 2:
        return "one output only: a late channel is dead_time"
    reasons = [_here(effect, recording, o) for o in twin.outputs]
    if effect.shared and len(twin.outputs) < 2 and effect.name == "misalignment":
        return "one output only"
    return "" if "" in reasons else reasons[0]


def places_of(twin: Twin) -> tuple[Place, ...]:
    """Return the inner places of forces and flows.

    They are the states of differential equations, or the single equation of motion of the other dynamic twins.
    """
    return getattr(twin, "places", (AXIS,) if twin.feedback_on else ())


def _acts_at(twin: Twin, effect: Effect) -> list[Place]:
    """Return the places of a twin at which a force or flow may act: those of its kind and of the unit it requires."""

    def fits(unit: str) -> bool:
        return unit not in effect.not_units and (not effect.position_units or unit in effect.position_units)

    at = (p for p in places_of(twin) if not (effect.by_position and p.kind == "motion" and p.position == p.velocity))
    return [p for p in at if p.kind in effect.acts_on and fits(_position_unit(twin, p))]


def _position_unit(twin: Twin, place: Place) -> str:
    return twin.units.get(twin.feedback_on, "").removesuffix("/s") if place == AXIS else place.unit


def _here(effect: Effect, recording: Recording, output: str) -> str:
    return effect.available(recording.signals, output) if effect.available is not None else ""


def _stage(twin: Twin, effect: Effect) -> Stage:
    fitting: list[Stage] = [s for s in effect.stages if s in twin.chain]
    return fitting[0] if fitting else effect.stages[0]


def _commutes(twin: Twin) -> bool:
    """Return True if a linear effect before the twin is equivalent to one behind it.

    It is not where the twin's equations may be nonlinear, where each stretch starts from measured states, or where the
    inside is unknown: a motor's angle keeps the effect of its first command.
    """
    return not hasattr(twin, "places") and not isinstance(getattr(twin, "core", twin), OpaqueTwin)


def _behind(twin: Twin, effect: Effect, stage: Stage) -> Stage:
    """Return the first stage behind the mechanics that an effect may have in a chain, else ``stage``."""
    late: list[Stage] = [s for s in effect.stages if s in twin.chain and STAGES.index(s) > STAGES.index("mechanics")]
    return late[0] if late else stage


def _sites(twin: Twin, recording: Recording, effect: Effect, present: Sequence[Placed]) -> list[Placed]:
    if _why_not(twin, recording, effect):
        return []
    stage = _stage(twin, effect)
    if effect.kind == "feedback":
        # a force moves every output of its equation of motion
        if places_of(twin) != (AXIS,):
            return [Placed(effect, "feedback", p.name, stage, twin.outputs) for p in _acts_at(twin, effect)]
        others = tuple(o for o in twin.outputs if o != twin.feedback_on)
        return [Placed(effect, "feedback", twin.feedback_on, stage, (twin.feedback_on, *others))]
    usable = tuple(o for o in twin.outputs if not _here(effect, recording, o))
    if effect.shared:
        return [Placed(effect, "output", "+".join(g), stage, g) for g in _groups(twin, effect, usable)]
    if effect.name in _WHOLE_RECORD:
        late = [Placed(effect, "output", "+".join(twin.outputs), stage, twin.outputs, note=SAME)]
        if effect.name == "dead_time" and not twin.static and (len(twin.inputs) > 1 or not _commutes(twin)):
            # one command may be late while the other inputs are not
            late = [replace(late[0], note="")]
            drives: list[Stage] = [d for d in _DRIVES if d in twin.chain]
            late += [Placed(effect, "input", s, (*drives, stage)[0], twin.outputs) for s in twin.inputs]
        return late
    inputs, outputs = "input" in effect.sites, "output" in effect.sites
    together: list[Placed] = []
    if effect.name in _ALIKE and len(twin.outputs) > 1:
        together = [Placed(effect, "output", "+".join(twin.outputs), stage, twin.outputs)]
    if twin.static and effect.kind == "add" and not outputs:
        return []  # nothing tells what is added in front of a gain from what is added behind it
    if twin.static:
        return together + _static(twin, effect, stage, usable, inputs=inputs, outputs=outputs, present=bool(present))
    found: list[Placed] = together
    if outputs:
        # behind a plant with states only what does not commute with it tells its place: it sits at the sensor
        behind = stage if effect.kind == "linear" else _behind(twin, effect, stage)
        # and what an actuator alone can have is in front of it
        if effect.kind == "linear" or STAGES.index(behind) >= STAGES.index("mechanics"):
            found += [Placed(effect, "output", o, behind, (o,)) for o in usable]
    if inputs and (effect.driven or not outputs):
        if effect.kind == "linear" and len(twin.inputs) == 1 and outputs and not present and _commutes(twin):
            return [Placed(p.effect, p.site, p.target, p.stage, p.outputs, note=SAME) for p in found]
        found += [Placed(effect, "input", s, stage, twin.outputs) for s in twin.inputs]
    if between_of(twin) and (inputs or "between" in effect.sites) and effect.driven and effect.kind != "linear":
        found.append(Placed(effect, "input", between_of(twin), "mechanics", twin.outputs))
    return found


def _static(
    twin: Twin, effect: Effect, stage: Stage, usable: tuple[str, ...], *, inputs: bool, outputs: bool, present: bool
) -> list[Placed]:
    found: list[Placed] = []
    note = SAME if inputs and outputs else ""
    for o in usable:
        drive = twin.drive(o)
        before = inputs and drive and effect.kind != "add" and stage in _DRIVES and stage in twin.chain
        if before:
            found.append(Placed(effect, "input", drive, stage, (o,), note=note))
            if outputs and present:
                late: Stage = "sensor" if "sensor" in twin.chain else twin.chain[-1]
                found.append(Placed(effect, "output", o, late, (o,)))
        else:
            found.append(Placed(effect, "output", o, stage, (o,), note=note))
    return found


def _groups(twin: Twin, effect: Effect, usable: tuple[str, ...]) -> list[tuple[str, ...]]:
    """Return the groups of outputs that share a set of weights.

    A position error is shared by the outputs of a location, a rotated package by those of one location or of all, any
    other effect by all outputs.
    """
    if effect.name not in ("sensor_position_error", "misalignment"):
        return [usable]
    by: dict[float, list[str]] = {}
    for o in usable:
        by.setdefault(twin.facts(o).get("location", (0.0,))[0], []).append(o)
    packages = [tuple(g) for g in by.values()]
    if effect.name == "misalignment":
        return [usable] + [g for g in packages if 1 < len(g) < len(usable)]
    return packages
