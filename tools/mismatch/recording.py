"""Represents a recording with its twin (section 1 of the contract) after loading, conversion and checks."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from hal.arrays import Array


@dataclass(frozen=True)
class Split:
    """Holds the optional ``[split]`` table: sample ranges (stop excluded) or another recording."""

    fit: tuple[int, int] | Path | None = None
    test: tuple[int, int] | Path | None = None
    initialization: int | None = None


Simulate = Callable[[Mapping[str, Array], Mapping[str, Any], float], "Mapping[str, Array] | Array"]
"""``simulate(inputs, parameters, dt)``: each input (n,) by name, parameters by name, the time step in s; returns each
output (n,) by name, or the array alone where there is one output."""


@dataclass(frozen=True)
class TwinText:
    """Holds the ``[twin]`` table: kind, the engineer's parameters, effects of a corrected twin.

    ``simulate`` is the twin itself where it was given as a function; its parameters ``fixed`` are not fitted.
    """

    kind: str
    parameters: Mapping[str, Any]
    effects: tuple[Mapping[str, Any], ...] = ()
    simulate: Simulate | None = None
    fixed: tuple[str, ...] = ()


Condition = float | str
"""Condition under which a recording was made: a number, or a word (the name of an operator)."""


@dataclass(frozen=True)
class Part:
    """Describes one of several joined recordings: its samples ``start`` to ``stop`` (excluded) and its conditions."""

    name: str
    start: int
    stop: int
    conditions: Mapping[str, Condition] = field(default_factory=dict[str, Condition])


@dataclass(frozen=True)
class Recording:
    """Holds all columns, float64 (n,), in the contract's units, uniformly sampled.

    ``noise``: declared rms noise of an output in its contract unit, or None. ``input_noise``: declared rms noise of the
    measured inputs, whose columns are conditional means (``input_noise.py``). ``unit``: the contract unit of each
    signal. ``column``: the name in the data file. ``declared_step``: resolution of an output if declared.
    ``tolerance``: differences of an output that do not matter to the user, in its contract unit. ``segments``: samples
    other than the first at which a new run begins: plants with states restart there. ``conditions``: the table
    ``[conditions]``, dates as days since 1970. ``parts``: the joined recordings (empty for a single one); the memory of
    effects restarts in each. ``per_recording``: base parameters that are free in each part; ``levels``: deviations of
    each part's base parameters from the shared ones (parts, parameters) whose influence was removed from the outputs.
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
    input_noise: Mapping[str, float] = field(default_factory=dict[str, float])

    @property
    def file_unit(self) -> dict[str, str]:
        """Return the unit of each signal in the data file."""
        return {**self.unit, **self.declared_unit}

    def segments_of(self, start: int, stop: int) -> tuple[int, ...]:
        """Return the segments that begin within samples ``start`` to ``stop``, counted from ``start``."""
        return tuple(s - start for s in self.segments if start < s < stop)

    @property
    def n(self) -> int:
        """Return the number of samples."""
        return self.t.size

    @property
    def signals(self) -> dict[str, Array]:
        """Return inputs and context together: the signals that an effect may use."""
        return {**self.context, **self.inputs}
