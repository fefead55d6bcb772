"""Represents a twin as two linear filters in series with a place for effects between them (Wiener-Hammerstein).

A state-space twin of one input and one output does not determine the place of a curve in its chain: any split of its
poles and zeros into a first and a second filter gives the same twin, as long as nothing stands between them. The gain
of the first filter is fixed, because only the product of both gains is observable.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from sim_devices.physics.effect import Array, Human
from tools.errors import RecordingError
from tools.mismatch.recording import Recording, TwinText
from tools.mismatch.twins.base import Counted, Force, Run, Signal, fold
from tools.mismatch.twins.dynamic import CONSTANT, DynamicTwin, discretise_blocks
from tools.mismatch.twins.head import Head
from tools.mismatch.twins.holds import Holds, read_holds
from tools.mismatch.twins.linear import between_samples, run_states
from tools.mismatch.twins.memo import remember

BETWEEN = "between"
"""Signal between the two filters: the target of effects there."""
FILTER = ("A", "B", "C", "D")
"""Keys of the first filter's table."""


@dataclass(frozen=True)
class CascadeTwin(Head):
    """Simulates two filters; theta = those of the ``second``, then the ``free`` ones (indices) of the ``first``."""

    first: DynamicTwin
    second: DynamicTwin
    free: tuple[int, ...]
    restart: bool
    holds: Holds
    fastest_per_s: float
    feedback_on: str = ""
    static: bool = False
    apart: bool = False
    counted: Counted = ""

    def start(self, recording: object) -> Array:
        """See Twin."""
        return np.concatenate([self.second.begin, self.first.begin[list(self.free)]])

    def first_theta(self, theta: Array) -> Array:
        """Return the parameters of the first filter, including fixed ones."""
        out = self.first.begin.copy()
        n = len(self.second.parameters)
        out[list(self.free)] = theta[n : n + len(self.free)]
        return out

    def second_theta(self, theta: Array) -> Array:
        """Return the parameters of the second filter; those of the first filter and of effects follow them."""
        return theta[: len(self.second.parameters)]

    def drive(self, output: str) -> str:
        """See Twin."""
        return self.inputs[0]

    def facts(self, output: str) -> Mapping[str, tuple[float, ...]]:
        """See Twin."""
        return {}

    def sensitivity(self, output: str, theta: Array) -> float:
        """See Twin: what effects at an input carry is in input units."""
        return 1.0

    def input_gain(self, signal: str, theta: Array) -> float:
        """See Twin."""
        return self.second.input_gain(BETWEEN, self.second_theta(theta)) if signal == BETWEEN else 1.0

    def between(self, run: Run, drive: Signal, theta: Array) -> Signal:
        """Return the signal between the filters for the input ``drive``; the first filter starts at rest."""
        u = fold(drive, theta)
        own = self.first_theta(theta)
        value = remember(run.memo, ("between", own.tobytes(), u.token), lambda: self._first(run, u.value, own))
        return Signal(value, {}, (*u.token, BETWEEN, own.tobytes()))

    def _first(self, run: Run, u: Array, own: Array) -> Array:
        plant = self.first.plant_of(own)
        y = np.zeros(u.size)
        hold = self.holds[self.inputs[0]]
        inside = np.ascontiguousarray(between_samples(u, hold), np.float64)
        start = np.zeros(1, np.int64)
        states = [
            run_states(d.ad, d.g0, d.g1, inside, np.zeros((1, d.ad.shape[0])), start)
            for d in discretise_blocks(plant, run.dt, hold)
        ]
        x = np.concatenate(states, axis=1) if states else np.zeros((u.size, 0))
        for link in self.first.links:
            if link.source != CONSTANT:
                y += own[link.j] * (u if link.row < 0 else x[:, link.row])
        return y

    def respond(
        self, run: Run, inputs: Mapping[str, Signal], theta: Array, forces: Sequence[Force], join: bool
    ) -> dict[str, Signal]:
        """See Twin."""
        middle = inputs.get(BETWEEN) or self.between(run, inputs[self.inputs[0]], theta)
        return self.second.respond(run, {BETWEEN: middle}, theta, (), join)

    def through(self, run: Run, signal: str, theta: Array, output: str) -> Callable[[Array], Array]:
        """See Twin."""
        carry = self.second.through(run, BETWEEN, theta, output)
        if signal == BETWEEN:
            return carry
        own = self.first_theta(theta)
        return lambda change: carry(self._first(run, change, own))

    def human(self, theta: Array) -> Sequence[Human]:
        """See Twin."""
        names = self.first.parameters
        before = [
            Human(f"first_{names[i].name}", float(self.first_theta(theta)[i]), names[i].unit)
            for i in self.free
            if i < len(names) - len(self.first.links)
        ]
        return [*self.second.human(self.second_theta(theta)), *before]

    def to_text(self, theta: Array) -> dict[str, object]:
        """See Twin."""
        first = self.first.to_text(self.first_theta(theta))
        return {**self.second.to_text(self.second_theta(theta)), "first": {k: first[k] for k in FILTER}}


def between_of(twin: object) -> str:
    """Return the name of the signal between two filters, "" for a twin that has none."""
    return BETWEEN if isinstance(twin, CascadeTwin) else ""


def cascade_twin(recording: Recording, build: Callable[[Recording], DynamicTwin]) -> CascadeTwin:
    """Build the twin of a recording whose state-space table has a ``first`` filter; ``build`` makes each filter.

    Raises RecordingError for more than one input or output, and if the first filter's entry is not a table.
    """
    where = f"{recording.path}: [twin.parameters] first"
    if len(recording.inputs) != 1 or len(recording.outputs) != 1:
        raise RecordingError(f"{where}: only a twin of one input and one output may have a filter in front")
    text = dict(recording.twin.parameters)
    table = text.pop("first")
    if not isinstance(table, Mapping) or not set(table) <= set(FILTER):
        raise RecordingError(f"{where} must be a table with A, B, C and D")
    (source, drive), (output, _) = *recording.inputs.items(), *recording.outputs.items()
    if "hold" in text:
        text["hold"] = read_holds(recording)[source]  # both filters name their input otherwise
    shared: dict[str, Any] = {k: text[k] for k in ("hold", "discrete") if k in text}
    units = {**recording.unit, BETWEEN: recording.unit[source]}
    rest = {k: v for k, v in text.items() if k != "x0"}
    second = build(replace(recording, inputs={BETWEEN: drive}, unit=units, twin=TwinText("state_space", rest)))
    first = build(
        replace(recording, outputs={BETWEEN: drive}, unit=units, twin=TwinText("state_space", {**table, **shared}))
    )
    gains = [link.j for link in first.links if link.source != CONSTANT]
    largest = max(gains, key=lambda j: abs(float(first.begin[j])))
    fixed = {largest, *(link.j for link in first.links if link.source == CONSTANT)}
    free = tuple(i for i in range(len(first.parameters)) if i not in fixed)
    return CascadeTwin(
        kind="state_space",
        inputs=(source,),
        outputs=(output,),
        units=units,
        chain=second.chain,
        parameters=(
            *second.parameters,
            *(replace(first.parameters[i], name=f"first_{first.parameters[i].name}") for i in free),
        ),
        first=first,
        second=second,
        free=free,
        restart=first.restart or second.restart,
        holds={source: second.holds[BETWEEN]},
        fastest_per_s=max(first.fastest_per_s, second.fastest_per_s),
    )
