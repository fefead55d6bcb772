"""Describes effects that a kind of twin cannot have, and bounds the probability of names without such rivals."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace

from sim_devices.physics.catalogue import EFFECTS
from tools.mismatch.engine.report import PhysicsFound
from tools.mismatch.twins.base import Twin
from tools.mismatch.twins.opaque import OpaqueTwin

MUCH_LEFT = 3.0
"""Ratio of residual to noise floor above which the named effects are not the whole account."""
NO_RIVAL = 0.5
"""Largest probability of a name beside a large rest: the complete explanation was not tried, or was not found."""
_INSIDE = "friction, springs, play, flows and limits inside its equations could not be tried"


def not_tried(twin: Twin) -> str:
    """Return a sentence on the effects that this kind of twin cannot have and the kind that can; "" without any."""
    core = getattr(twin, "core", twin)
    if core.kind == "columns":
        return (
            "This twin is columns of simulated output: only effects at outputs and late outputs were tried,"
            f" {_INSIDE}, and its parameters could not be re-fitted (a delay or a lag may be one of them that is off)."
            " A twin of kind 'ode' (the equations as text) allows it."
        )
    if not isinstance(core, OpaqueTwin):
        return ""
    what = {
        "fmu": "An FMU shows its inputs and outputs alone",
        "instrument": "The emulated bench shows its inputs and outputs alone",
    }.get(core.kind, "A twin in Python shows its inputs and outputs alone")
    more = " So does an FMU for model exchange (FMI 2) if its equations are linear." if core.kind == "fmu" else ""
    return (
        f"{what}: {_INSIDE}. A twin of kind 'ode' (the equations as text or a function of derivatives) allows it.{more}"
    )


def much_left(physics: Sequence[PhysicsFound], floors: Mapping[str, float]) -> bool:
    """Return True if the residual of the named effects is far above the noise: they are not the whole account."""
    return any(p.residual_rms_after > MUCH_LEFT * floors.get(p.output, p.residual_rms_after) for p in physics)


def out_of_reach(physics: Sequence[PhysicsFound], twin: Twin, floors: Mapping[str, float]) -> bool:
    """Return True if the named effects leave a large rest that may sit where this kind of twin allows no effects."""
    return bool(not_tried(twin)) and much_left(physics, floors)


def imitable(physics: Sequence[PhysicsFound], twin: Twin) -> list[bool]:
    """Return for each effect if a wrong parameter of the simulation can imitate it.

    This holds for a linear effect behind columns of simulated output, whose parameters cannot be re-fitted here, unless
    it takes the response to a constant away: no parameter of a simulation that has one does that.
    """
    columns = getattr(twin, "core", twin).kind == "columns"
    linear = {name for name, effect in EFFECTS.items() if effect.is_linear and not effect.loses_mean}
    return [columns and p.name in linear for p in physics]


def tempered(physics: Sequence[PhysicsFound]) -> list[PhysicsFound]:
    """Return the effects with probabilities of at most ``NO_RIVAL``, since the explanation of the rest was no rival."""
    return [replace(p, confidence=min(p.confidence, NO_RIVAL)) for p in physics]
