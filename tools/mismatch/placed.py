"""An effect at its place of a chain, and the entries of a parameter vector."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Literal

import numpy as np

from sim_devices.physics.effect import Effect, Parameter, Parts, Settings, Stage


@dataclass(frozen=True)
class Placed:
    """Places an effect in the chain.

    ``site`` is its position in the flow; ``target`` is the input or output signal there; ``outputs`` are those whose
    residual it may change (several for shared effects); ``note`` lists places that the recording cannot distinguish
    from this one.
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
        """Return the parameters of the effect."""
        return self.effect.parts(self.settings)

    @property
    def weights_beside(self) -> int:
        """Return the number of the last weights, which alone do not show the effect."""
        return self.effect.weights_beside(self.settings) if self.effect.weights_beside is not None else 0

    @property
    def label(self) -> str:
        """Return a name for parameter lists and logs, e.g. ``creep[displacement]``."""
        return f"{self.effect.name}[{self.target}]"


@dataclass(frozen=True)
class Free:
    """Describes an entry of the parameter vector."""

    name: str
    unit: str
    lo: float
    hi: float
    log: bool
    scale: float
    linear: bool
    placed: int
    """Index of the placed effect; -1 for base parameters."""
    away: float | None = None
    """Value at which the parameter has no influence."""


def middle(p: Parameter | Free) -> float:
    """Return the middle of the bounds (geometric if searched by logarithm), or the scale of an unbounded parameter."""
    lo, hi = p.lo, p.hi
    if p.log and lo > 0 and np.isfinite(hi):
        return float(np.sqrt(lo * hi))
    if np.isfinite(lo) and np.isfinite(hi):
        return 0.5 * (lo + hi)
    return float(min(max(p.scale, lo), hi))


def free_entry(p: Parameter, u_in: str, u_out: str, prefix: str, k: int) -> Free:
    """Return the entry of parameter ``p`` of placed effect ``k`` (-1: base), its unit in those of input and output."""
    unit = p.unit.replace("{in}", u_in).replace("{out}", u_out)
    return Free(prefix + p.name, unit, p.lo, p.hi, p.log, p.scale, False, k, p.away)
