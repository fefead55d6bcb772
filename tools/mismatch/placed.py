"""An effect at its place of a chain, and the entries of a parameter vector."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Literal

import numpy as np

from sim_devices.physics.effect import Effect, Parameter, Parts, Settings, Stage


@dataclass(frozen=True)
class Placed:
    """One effect at one place of the chain.

    ``site``: where in the flow; ``target``: the input or output signal there; ``outputs``: whose residual it may
    change (several for shared effects); ``note`` lists places that the recording cannot tell from this one.
    """

    effect: Effect
    site: Literal["input", "output", "feedback"]
    target: str
    stage: Stage
    outputs: tuple[str, ...]
    settings: Settings = field(default_factory=dict[str, tuple[float, ...]])
    note: str = ""

    @property
    def parts(self) -> Parts:
        """Its parameters."""
        return self.effect.parts(self.settings)

    @property
    def label(self) -> str:
        """Name for parameter lists and logs, e.g. ``creep[displacement]``."""
        return f"{self.effect.name}[{self.target}]"


@dataclass(frozen=True)
class Free:
    """One entry of the parameter vector."""

    name: str
    unit: str
    lo: float
    hi: float
    log: bool
    scale: float
    linear: bool
    placed: int
    """-1 for base parameters, else the index of the placed effect."""
    away: float | None = None
    """Where it does nothing."""


def middle(p: Parameter | Free) -> float:
    """Of the bounds (geometric where searched by logarithm), or the parameter's scale when it has none."""
    lo, hi = p.lo, p.hi
    if p.log and lo > 0 and np.isfinite(hi):
        return float(np.sqrt(lo * hi))
    if np.isfinite(lo) and np.isfinite(hi):
        return 0.5 * (lo + hi)
    return float(min(max(p.scale, lo), hi))


def free_entry(p: Parameter, u_in: str, u_out: str, prefix: str, k: int) -> Free:
    """The entry of parameter ``p`` of placed effect ``k`` (-1: base), its unit in those of input and output."""
    unit = p.unit.replace("{in}", u_in).replace("{out}", u_out)
    return Free(prefix + p.name, unit, p.lo, p.hi, p.log, p.scale, False, k, p.away)
