"""Implements the common part of built-in twins: names, chain, and outputs that are an offset plus a scaled input."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass

from sim_devices.physics.effect import Array, Parameter, Stage
from tools.mismatch.twins.base import Run


@dataclass(frozen=True)
class Head:
    """Holds the common fields of built-in twins (see ``Twin``)."""

    kind: str
    inputs: tuple[str, ...]
    outputs: tuple[str, ...]
    units: Mapping[str, str]
    chain: tuple[Stage, ...]
    parameters: tuple[Parameter, ...]


@dataclass(frozen=True)
class ScaledOutputs(Head):
    """Scales inputs without memory; theta = offset of every output, then scale of every output."""

    def sensitivity(self, output: str, theta: Array) -> float:
        """See Twin."""
        return float(theta[len(self.outputs) + self.outputs.index(output)])

    def input_gain(self, signal: str, theta: Array) -> float:
        """See Twin."""
        return 1.0

    def through(self, run: Run, signal: str, theta: Array, output: str) -> Callable[[Array], Array]:
        """See Twin."""
        gain = self.sensitivity(output, theta)
        return lambda change: gain * change
