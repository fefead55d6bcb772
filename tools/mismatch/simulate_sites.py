"""Where in a chain an effect may sit; places that a recording cannot tell apart are one place with a note."""

from __future__ import annotations

from collections.abc import Sequence

from sim_devices.physics.effect import Effect, Stage
from tools.mismatch.recording import Recording
from tools.mismatch.simulate import Placed
from tools.mismatch.twins.base import Twin


def sites(twin: Twin, recording: Recording, effect: Effect, present: Sequence[Placed] = ()) -> list[Placed]:
    """Places for ``effect``, likeliest first. Empty: this twin or recording cannot have it (see ``why_not``).

    ``present``: effects that are already placed; behind a nonlinear one, input and output are different places.
    """
    if why_not(twin, recording, effect):
        return []
    stages = [s for s in twin.chain if s in effect.stages] or [effect.stages[0]]
    if effect.kind == "feedback":
        return [Placed(effect, "feedback", twin.feedback_on, _stage(stages, "mechanics"), (twin.feedback_on,))]
    if effect.shared:
        return [Placed(effect, "output", "*", stages[0], twin.outputs)]
    inputs = "input" in effect.sites
    outputs = "output" in effect.sites
    found: list[Placed] = []
    if twin.static:
        add = effect.kind == "add"
        for o in twin.outputs:
            drive = twin.drive(o)
            if add or not inputs or not drive:
                note = "input or output" if add and inputs and outputs else ""
                found.append(Placed(effect, "output", o, stages[0], (o,), note=note))
            else:
                note = "input or output" if outputs else ""
                found.append(Placed(effect, "input", drive, stages[0], (o,), note=note))
                if outputs and present:
                    found.append(Placed(effect, "output", o, stages[-1], (o,)))
        return found
    if outputs:
        found += [Placed(effect, "output", o, stages[-1], (o,)) for o in twin.outputs]
    if inputs and effect.driven:
        # a linear operator commutes with a linear twin that has one input
        merged = effect.kind == "linear" and len(twin.inputs) == 1 and outputs and not present
        if merged:
            found = [Placed(p.effect, p.site, p.target, p.stage, p.outputs, note="input or output") for p in found]
        else:
            found += [Placed(effect, "input", s, stages[0], twin.outputs) for s in twin.inputs]
    return found


def why_not(twin: Twin, recording: Recording, effect: Effect) -> str:
    """Why an effect cannot be proposed here, in words; "" if it can."""
    if effect.twins and twin.kind not in effect.twins:
        return f"not in a {twin.kind}"
    if effect.kind == "feedback" and not twin.feedback_on:
        return "the twin has no equation of motion"
    missing = [s for s in effect.needs if s not in recording.signals]
    if missing:
        return f"{', '.join(missing)} not recorded"
    return ""


def _stage(stages: Sequence[Stage], preferred: Stage) -> Stage:
    return preferred if preferred in stages else stages[0]
