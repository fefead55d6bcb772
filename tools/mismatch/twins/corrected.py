"""Combines base physics with effects that an earlier diagnosis found into a corrected twin.

The engine sees an ordinary twin with more base parameters, so that known effects are re-fitted as a gain is (verdict
``recalibrate``) and are not found a second time. The weights of an effect with many elements (hysteresis, creep) are
re-fitted by a common factor, because a new recording need not excite each of them. Additions from outside (hum,
warm-up) keep free weights: their phase and level belong to the recording.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from sim_devices.physics.effect import Array, Human, Parameter
from tools.errors import RecordingError
from tools.mismatch.recording import Recording
from tools.mismatch.simulate import Model
from tools.mismatch.simulate_text import describe, restore
from tools.mismatch.twins.base import Counted, Force, Run, Signal, Twin, fold
from tools.mismatch.twins.head import Head

MOST_FREE = 3  # largest number of weights of an effect that are re-fitted one by one


@dataclass(frozen=True)
class CorrectedTwin(Head):
    """Wraps ``inner``, the core twin with its effects at ``found`` (its own theta).

    ``of[j]`` is the parameter of this twin that moves parameter ``j`` of the inner model; ``factor[j]`` is True if it
    multiplies it.
    """

    inner: Model
    found: tuple[float, ...]
    of: tuple[int, ...]
    factor: tuple[bool, ...]
    static: bool
    restart: bool
    feedback_on: str
    penalty: Array
    """Smoothness rows of weights that are free, (rows, len(parameters))."""
    apart: bool = False
    counted: Counted = ""

    @property
    def core(self) -> Twin:
        """Return the twin without its effects."""
        return self.inner.twin

    def __getattr__(self, name: str) -> object:
        # attributes of some cores only (the fastest rate of a dynamic one); never the dataclass' own fields, which
        # pickle requests before they exist
        if name.startswith("_") or name in CorrectedTwin.__dataclass_fields__:
            raise AttributeError(name)
        return getattr(self.inner.twin, name)

    def start(self, recording: Recording) -> Array:
        """See Twin."""
        out = np.ones(len(self.parameters))
        for j, i in enumerate(self.of):
            if not self.factor[j]:
                out[i] = self.found[j]
        return out

    def inside(self, theta: Array) -> Array:
        """Return theta of the inner model for parameters of this twin (further ones are ignored)."""
        moved = theta[list(self.of)]
        return np.where(self.factor, moved * np.array(self.found), moved)

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
        inside = self.inside(theta)
        flow = self.inner.flow(run, folded, inside, forces, join)
        linear = set(self.inner.linear)
        out: dict[str, Signal] = {}
        for o, signal in flow.items():
            value, token = signal.value, (*signal.token, "corrected")
            columns: dict[int, Array] = {}
            for j, c in signal.columns.items():
                if j not in linear:
                    value, token = value + inside[j] * c, (*token, j, float(inside[j]))
                    continue
                column = self.found[j] * c if self.factor[j] else c
                i = self.of[j]
                columns[i] = columns[i] + column if i in columns else column
            out[o] = Signal(value, columns, token)
        return out

    def human(self, theta: Array) -> Sequence[Human]:
        """See Twin."""
        groups = self.inner.human(self.inside(theta))
        return [
            Human(h.name if group == "base" else f"{group}.{h.name}", h.value, h.unit)
            for group, values in groups.items()
            for h in values
        ]

    def to_text(self, theta: Array) -> dict[str, object]:
        """See Twin; the key ``effects`` holds the effects, re-fitted."""
        text = describe(self.inner, self.inside(theta))
        return {**text["parameters"], "effects": text["effects"]}


def corrected_twin(recording: Recording) -> CorrectedTwin:
    """Build the twin of a recording whose ``[twin]`` lists effects. Raises RecordingError if they do not match it."""
    model, theta = restore(recording)
    for i, placed in enumerate(model.placed):
        missing = [s for s in placed.effect.needs if s not in recording.signals]
        if missing:
            raise RecordingError(
                f"{recording.path}: [[twin.effects]] {i + 1}: {placed.effect.name} needs {', '.join(missing)},"
                " which this recording does not have"
            )
    twin = model.twin
    parameters: list[Parameter] = []
    of: list[int] = []
    factor: list[bool] = []
    banks = [model.slices(k)[1] for k in range(len(model.placed))]
    # the step is proportional to the size of the weights, because their unit does not determine it
    step = {j: 0.02 * float(np.max(np.abs(theta[w]))) for w in banks for j in range(w.start, w.stop)}
    common = {
        j: w.start
        for w, placed in zip(banks, model.placed, strict=True)
        if placed.effect.driven and w.stop - w.start > MOST_FREE
        for j in range(w.start, w.stop)
    }
    for j, f in enumerate(model.parameters):
        first = common.get(j)
        factor.append(first is not None)
        if first is not None and first != j:
            of.append(of[first])
            continue
        of.append(len(parameters))
        if first is None:
            parameters.append(Parameter(f.name, f.unit, f.lo, f.hi, f.log, step.get(j) or f.scale))
        else:
            parameters.append(Parameter(f"{f.name.rsplit('.', 1)[0]}.strength", "1", scale=0.05))
    rows = model.smoothness()
    rows = rows[~np.any(rows[:, np.array(factor)] != 0.0, axis=1)]
    penalty = np.zeros((rows.shape[0], len(parameters)))
    for j, i in enumerate(of):
        if not factor[j]:
            penalty[:, i] = rows[:, j]
    return CorrectedTwin(
        twin.kind,
        twin.inputs,
        twin.outputs,
        twin.units,
        twin.chain,
        tuple(parameters),
        model,
        tuple(theta.tolist()),
        tuple(of),
        tuple(factor),
        twin.static,
        twin.restart,
        twin.feedback_on,
        penalty,
        counted=twin.counted,
    )
