"""A corrected twin: base physics with effects that an earlier diagnosis found, as one twin.

The engine sees an ordinary twin with more base parameters, so that effects that are known already are re-fitted
like a gain is (verdict ``recalibrate``) and are not found a second time.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from sim_devices.physics.effect import Array, Human, Parameter, Stage
from tools.mismatch.recording import Recording, RecordingError
from tools.mismatch.simulate import Model
from tools.mismatch.simulate_text import describe, restore
from tools.mismatch.twins.base import Force, Run, Signal, Twin, fold


@dataclass(frozen=True)
class CorrectedTwin:
    """``inner`` is the core twin with its effects, ``begin`` its parameters: those of the core first."""

    kind: str
    inputs: tuple[str, ...]
    outputs: tuple[str, ...]
    units: Mapping[str, str]
    chain: tuple[Stage, ...]
    parameters: tuple[Parameter, ...]
    inner: Model
    begin: tuple[float, ...]
    static: bool
    restart: bool
    feedback_on: str
    penalty: Array
    """Smoothness rows of the effects, (rows, len(parameters))."""

    @property
    def core(self) -> Twin:
        """The twin without its effects."""
        return self.inner.twin

    def __getattr__(self, name: str) -> object:
        # what only some cores have (the fastest rate of a dynamic one); never the dataclass' own fields, which
        # pickle asks for before they are there
        if name.startswith("_") or name in CorrectedTwin.__dataclass_fields__:
            raise AttributeError(name)
        return getattr(self.inner.twin, name)

    def start(self, recording: Recording) -> Array:
        """See Twin."""
        return np.array(self.begin)

    def drive(self, output: str) -> str:
        """See Twin."""
        return self.core.drive(output)

    def facts(self, output: str) -> Mapping[str, tuple[float, ...]]:
        """See Twin."""
        return self.core.facts(output)

    def sensitivity(self, output: str, theta: Array) -> float:
        """See Twin."""
        return self.core.sensitivity(output, theta[: self.inner.n_base])

    def input_gain(self, signal: str, theta: Array) -> float:
        """See Twin."""
        return self.core.input_gain(signal, theta[: self.inner.n_base])

    def through(self, run: Run, signal: str, theta: Array, output: str) -> Callable[[Array], Array] | None:
        """See Twin: of the core, without the effects."""
        return self.core.through(run, signal, theta[: self.inner.n_base], output)

    def respond(
        self, run: Run, inputs: Mapping[str, Signal], theta: Array, forces: Sequence[Force], join: bool
    ) -> dict[str, Signal]:
        """See Twin. Columns of the inputs are folded: behind the effects they would not stay linear."""
        folded = {s: fold(x, theta, self.input_gain(s, theta)) for s, x in inputs.items()}
        flow = self.inner.flow(run, folded, theta, forces, join)
        keep = set(self.inner.linear)
        out: dict[str, Signal] = {}
        for o, signal in flow.items():
            lost = {j: c for j, c in signal.columns.items() if j not in keep}
            value, token = signal.value, signal.token
            for j, c in lost.items():
                value = value + theta[j] * c
                token = (*token, (j, float(theta[j])))
            out[o] = Signal(value, {j: c for j, c in signal.columns.items() if j in keep}, token)
        return out

    def human(self, theta: Array) -> Sequence[Human]:
        """See Twin."""
        groups = self.inner.human(theta[: len(self.parameters)])
        return [
            Human(h.name if group == "base" else f"{group}.{h.name}", h.value, h.unit)
            for group, values in groups.items()
            for h in values
        ]

    def to_text(self, theta: Array) -> dict[str, object]:
        """See Twin; the key ``effects`` holds the effects, re-fitted."""
        text = describe(self.inner, theta[: len(self.parameters)])
        return {**text["parameters"], "effects": text["effects"]}


def corrected_twin(recording: Recording) -> CorrectedTwin:
    """The twin of a recording whose ``[twin]`` lists effects. Raises RecordingError for what does not fit."""
    model, theta = restore(recording)
    for i, placed in enumerate(model.placed):
        missing = [s for s in placed.effect.needs if s not in recording.signals]
        if missing:
            raise RecordingError(
                f"{recording.path}: [[twin.effects]] {i + 1}: {placed.effect.name} needs {', '.join(missing)},"
                " which this recording does not have"
            )
    twin = model.twin
    parameters = tuple(Parameter(f.name, f.unit, f.lo, f.hi, f.log, f.scale) for f in model.parameters)
    return CorrectedTwin(
        twin.kind,
        twin.inputs,
        twin.outputs,
        twin.units,
        twin.chain,
        parameters,
        model,
        tuple(theta.tolist()),
        twin.static,
        twin.restart,
        twin.feedback_on,
        model.smoothness(),
    )
