"""Implements twins without memory (piezo stack, accelerometer, magnetometer): outputs are offset plus scaled input."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from sim_devices.physics.effect import Array, Human, Parameter, Stage
from tools.errors import RecordingError
from tools.mismatch.keys import PARAMETERS, names
from tools.mismatch.recording import Recording
from tools.mismatch.twins.base import Counted, Force, Run, Signal, fold
from tools.mismatch.twins.head import ScaledOutputs
from tools.mismatch.twins.holds import STRAIGHT_OR_HELD, read_holds
from tools.numbers import is_finite_number


@dataclass(frozen=True)
class StaticTwin(ScaledOutputs):
    """Simulates ``y_o = offset_o + scale_o * x_drive(o)``; theta = all offsets, then all scales.

    ``names`` are the contract's (offset, scale). ``given`` (outputs, 2) holds the engineer's numbers, NaN where
    missing: those are estimated by least squares.
    """

    drives: Mapping[str, str]
    names: tuple[str, str]
    given: tuple[tuple[float, float], ...]
    static: bool = True
    apart: bool = True
    restart: bool = False
    feedback_on: str = ""
    counted: Counted = ""

    def start(self, recording: Recording) -> Array:
        """See Twin."""
        m = len(self.outputs)
        theta = np.empty(2 * m)
        for i, o in enumerate(self.outputs):
            offset, scale = self.given[i]
            x, y = recording.inputs[self.drives[o]], recording.outputs[o]
            if np.isnan(scale):
                dx = x - x.mean()
                if np.isnan(offset):
                    scale = float(dx @ y / (dx @ dx))
                else:
                    scale = float(x @ (y - offset) / (x @ x))
            if np.isnan(offset):
                offset = float(np.mean(y - scale * x))
            theta[i], theta[m + i] = offset, scale
        return theta

    def drive(self, output: str) -> str:
        """See Twin."""
        return self.drives[output]

    def facts(self, output: str) -> Mapping[str, tuple[float, ...]]:
        """See Twin."""
        return {"axis": ("xyz".find(output[-1]),)} if "_" in output else {}

    def respond(
        self, run: Run, inputs: Mapping[str, Signal], theta: Array, forces: Sequence[Force], join: bool
    ) -> dict[str, Signal]:
        """See Twin. A scaled input with columns of its own is folded: its scale is a parameter too."""
        m = len(self.outputs)
        out: dict[str, Signal] = {}
        for i, o in enumerate(self.outputs):
            x = fold(inputs[self.drives[o]], theta)
            one = np.ones_like(x.value)
            key = (*x.token, "static", o)
            if join:
                out[o] = Signal(theta[i] + theta[m + i] * x.value, {}, (*key, theta[i], theta[m + i]))
            else:
                out[o] = Signal(np.zeros_like(x.value), {i: one, m + i: x.value}, key)
        return out

    def human(self, theta: Array) -> Sequence[Human]:
        """See Twin."""
        m = len(self.outputs)
        return [Human(p.name, float(theta[i]), p.unit) for i, p in enumerate(self.parameters[: 2 * m])]

    def to_text(self, theta: Array) -> dict[str, object]:
        """See Twin."""
        m = len(self.outputs)
        offsets, scales = theta[:m].tolist(), theta[m : 2 * m].tolist()
        if m == 1:
            return {self.names[0]: offsets[0], self.names[1]: scales[0]}
        return {
            self.names[0]: dict(zip(self.outputs, offsets, strict=True)),
            self.names[1]: dict(zip(self.outputs, scales, strict=True)),
        }


_KINDS: dict[str, tuple[str, str, tuple[Stage, ...]]] = {
    "piezo_stack": (
        "offset_um",
        "gain_um_per_V",
        ("amplifier", "actuator", "mechanics", "environment", "sensor", "acquisition"),
    ),
    "accelerometer": ("bias_V", "scale_V_per_g", ("mounting", "sensor", "environment", "acquisition")),
    "magnetometer": ("bias_V", "scale_V_per_uT", ("mounting", "environment", "sensor", "acquisition")),
}


def static_twin(recording: Recording) -> StaticTwin:
    """Build the twin that a recording names, restricted to the recorded axes."""
    kind = recording.twin.kind
    offset, scale, chain = _KINDS[kind]
    inputs = tuple(recording.inputs)
    outputs = tuple(recording.outputs)
    drives: dict[str, str] = {}
    for o in outputs:
        drive = inputs[0] if kind == "piezo_stack" else next((s for s in inputs if s[-2:] == o[-2:]), "")
        if not drive:
            raise RecordingError(
                f"{recording.path}: output '{o}' has no input of its own axis; record or leave out both"
            )
        drives[o] = drive
    text = recording.twin.parameters
    known = names(PARAMETERS[kind])
    read_holds(recording, STRAIGHT_OR_HELD)
    for key in text:
        # a twin without memory is the same for either hold at the samples, where it is compared
        if key not in known:
            raise RecordingError(
                f"{recording.path}: [twin.parameters] '{key}' is not a parameter of {kind}; known: {', '.join(known)}"
            )
    return gain_and_offset(recording, (offset, scale), drives, chain)


def gain_and_offset(
    recording: Recording,
    names: tuple[str, str],
    drives: Mapping[str, str],
    chain: tuple[Stage, ...],
    missing: tuple[float, float] = (np.nan, np.nan),
) -> StaticTwin:
    """Build the twin whose outputs are each an offset plus a scaled input.

    ``missing``: defaults for offset and scale that are not given (NaN: estimated).
    """
    (offset, scale), text = names, recording.twin.parameters
    inputs, outputs = tuple(recording.inputs), tuple(recording.outputs)
    given = tuple(
        (
            _one(recording, text.get(offset, missing[0]), offset, o, i),
            _one(recording, text.get(scale, missing[1]), scale, o, i),
        )
        for i, o in enumerate(outputs)
    )
    many = len(outputs) > 1
    parameters: list[Parameter] = []
    for name, unit in ((offset, "{out}"), (scale, "")):
        for o, (b, s) in zip(outputs, given, strict=True):
            u = recording.unit[o] if unit else f"{recording.unit[o]}/{recording.unit[drives[o]]}"
            typical = s if unit == "" and np.isfinite(s) and s else 1.0
            if unit and np.isfinite(b) and b:
                typical = b
            parameters.append(Parameter(f"{name}[{o}]" if many else name, u, scale=abs(typical)))
    return StaticTwin(
        recording.twin.kind, inputs, outputs, recording.unit, chain, tuple(parameters), drives, names, given
    )


def _one(recording: Recording, value: object, name: str, output: str, i: int) -> float:
    if value is None:
        return float("nan")
    if isinstance(value, Mapping):
        value = value.get(output, value.get(output[-1]))
    elif isinstance(value, Sequence) and not isinstance(value, str):
        if len(value) != len(recording.outputs):
            raise RecordingError(
                f"{recording.path}: [twin.parameters] {name} has {len(value)} entries,"
                f" expected one or {len(recording.outputs)}"
            )
        value = value[i]
    if value is None or value is np.nan:
        return float("nan")
    if not is_finite_number(value):
        raise RecordingError(f"{recording.path}: [twin.parameters] {name} must be a finite number, got {value!r}")
    return float(value)
