"""What a twin does not allow to be tried, and how sure a name can be that had no rival inside."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace

from sim_devices.physics.catalogue import EFFECTS
from tools.mismatch.engine.report import PhysicsFound
from tools.mismatch.twins.base import Twin
from tools.mismatch.twins.opaque import OpaqueTwin

MUCH_LEFT = 3.0
"""Residual over noise floor above which what was named is not the whole account."""
NO_RIVAL = 0.5
"""Most that a name is sure where much is left: the one that explains it all was not tried, or was not found."""
_INSIDE = "friction, springs, play, flows and limits inside its equations could not be tried"


def not_tried(twin: Twin) -> str:
    """What could not be tried on this kind of twin and which kind would allow it, in a sentence; "" if all could."""
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
        "fmu": "An FMU for co-simulation shows its inputs and outputs alone",
        "instrument": "The emulated bench shows its inputs and outputs alone",
    }.get(core.kind, "A twin in Python shows its inputs and outputs alone")
    more = " So does an FMU for model exchange with linear equations." if core.kind == "fmu" else ""
    return (
        f"{what}: {_INSIDE}. A twin of kind 'ode' (the equations as text or a function of derivatives) allows it.{more}"
    )


def much_left(physics: Sequence[PhysicsFound], floors: Mapping[str, float]) -> bool:
    """Return whether what the named effects leave is far above the noise: they are not the whole account."""
    return any(p.residual_rms_after > MUCH_LEFT * floors.get(p.output, p.residual_rms_after) for p in physics)


def out_of_reach(physics: Sequence[PhysicsFound], twin: Twin, floors: Mapping[str, float]) -> bool:
    """Return whether the named effects leave much that may sit where this kind of twin lets nothing be tried."""
    return bool(not_tried(twin)) and much_left(physics, floors)


def imitable(physics: Sequence[PhysicsFound], twin: Twin) -> list[bool]:
    """For each effect, whether a parameter of the simulation that is off could be what it was taken for: a linear
    effect behind columns of simulated output, whose parameters nobody can re-fit here.
    """
    columns = getattr(twin, "core", twin).kind == "columns"
    linear = {name for name, effect in EFFECTS.items() if effect.is_linear}
    return [columns and p.name in linear for p in physics]


def tempered(physics: Sequence[PhysicsFound]) -> list[PhysicsFound]:
    """The same effects, none surer than ``NO_RIVAL``: what could explain the rest had no chance against them."""
    return [replace(p, confidence=min(p.confidence, NO_RIVAL)) for p in physics]
