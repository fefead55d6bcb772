"""A recording beside a twin: what section 1 of the contract describes, loaded, converted and checked."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Split:
    """The optional ``[split]`` table: sample ranges (stop excluded) or another recording."""

    fit: tuple[int, int] | Path | None = None
    test: tuple[int, int] | Path | None = None
    others: Mapping[str, tuple[int, int] | Path] = field(default_factory=dict[str, "tuple[int, int] | Path"])
    initialization: int | None = None


Simulate = Callable[[Mapping[str, Array], Mapping[str, Any], float], "Mapping[str, Array] | Array"]
"""``simulate(inputs, parameters, dt)``: each input (n,) by name, parameters by name, the time step in s; returns each
output (n,) by name, or the array alone where there is one output."""


@dataclass(frozen=True)
class TwinText:
    """The ``[twin]`` table: kind, the engineer's parameters, effects of a corrected twin.

    ``simulate`` is the twin itself where it was given as a function; its parameters ``fixed`` are not fitted.
    """

    kind: str
    parameters: Mapping[str, Any]
    effects: tuple[Mapping[str, Any], ...] = ()
    simulate: Simulate | None = None
    fixed: tuple[str, ...] = ()


Condition = float | str
"""What a recording was made under: a number, or a word (the name of an operator)."""


@dataclass(frozen=True)
class Part:
    """One of several recordings that were joined: its samples ``start`` to ``stop`` (excluded) and its conditions."""

    name: str
    start: int
    stop: int
    conditions: Mapping[str, Condition] = field(default_factory=dict[str, Condition])


@dataclass(frozen=True)
class Recording:
    """All columns float64 (n,), in the contract's units, uniformly sampled.

    ``noise``: declared rms noise of an output in its contract unit, or None. ``unit``: the contract unit of each
    signal. ``column``: the name in the data file. ``declared_step``: resolution of an output if declared.
    ``tolerance``: differences of an output that do not matter to the user, in its contract unit. ``segments``: samples
    other than the first at which a new run begins: plants with states start there afresh. ``conditions``: the table
    ``[conditions]``, dates as days since 1970. ``parts``: the recordings that were joined to this one (none: it is
    one); memory of effects begins afresh in each. ``per_recording``: base parameters that are free in each part;
    ``levels``: how far each part's base parameters (parts, parameters) lay from the shared ones, where that was taken
    off the outputs.
    """

    path: Path
    title: str
    t: Array
    dt: float
    inputs: Mapping[str, Array]
    outputs: Mapping[str, Array]
    context: Mapping[str, Array]
    noise: Mapping[str, float | None]
    unit: Mapping[str, str]
    column: Mapping[str, str]
    twin: TwinText
    split: Split
    declared_step: Mapping[str, float] = field(default_factory=dict[str, float])
    tolerance: Mapping[str, float] = field(default_factory=dict[str, float])
    warnings: tuple[str, ...] = ()
    declared_unit: Mapping[str, str] = field(default_factory=dict[str, str])
    segments: tuple[int, ...] = ()
    conditions: Mapping[str, Condition] = field(default_factory=dict[str, Condition])
    parts: tuple[Part, ...] = ()
    per_recording: tuple[str, ...] = ()
    levels: tuple[tuple[float, ...], ...] = ()

    @property
    def file_unit(self) -> dict[str, str]:
        """The unit of each signal in the data file."""
        return {**self.unit, **self.declared_unit}

    def segments_of(self, start: int, stop: int) -> tuple[int, ...]:
        """The segments that begin within samples ``start`` to ``stop``, counted from ``start``."""
        return tuple(s - start for s in self.segments if start < s < stop)

    @property
    def n(self) -> int:
        """Number of samples."""
        return self.t.size

    @property
    def signals(self) -> dict[str, Array]:
        """Inputs and context together: what an effect may look at."""
        return {**self.context, **self.inputs}
