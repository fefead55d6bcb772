"""Accelerometers at several places of one rigid body: a = axis . (f + alpha x r), alpha from the recorded rate."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from sim_devices.physics.effect import Array, Human, Parameter, Stage
from tools.errors import RecordingError
from tools.mismatch.keys import PARAMETERS, names
from tools.mismatch.recording import Recording
from tools.mismatch.twins.base import Counted, Force, Run, Signal, fold
from tools.mismatch.twins.head import ScaledOutputs
from tools.mismatch.twins.memo import remember

_NEXT = ((1, 2), (2, 0), (0, 1))


@dataclass(frozen=True)
class ClusterTwin(ScaledOutputs):
    """Simulates a cluster; theta = bias of every output, then scale of every output.

    They are 0 and 1 as given: the contract has neither, but every accelerometer does. Positions are not base
    parameters: a wrong one is ``sensor_position_error``.
    """

    positions: Mapping[str, tuple[float, float, float]]
    static: bool = True
    apart: bool = True
    restart: bool = False
    feedback_on: str = ""
    counted: Counted = ""

    def start(self, recording: Recording) -> Array:
        """See Twin."""
        m = len(self.outputs)
        return np.concatenate([np.zeros(m), np.ones(m)])

    def drive(self, output: str) -> str:
        """See Twin: the specific force along its axis."""
        return f"specific_force_{output[-1]}"

    def facts(self, output: str) -> Mapping[str, tuple[float, ...]]:
        """See Twin: ``axis`` index and ``position_m`` of the sensor, ``location`` as a number for grouping."""
        where = location(output)
        return {
            "axis": ("xyz".index(output[-1]),),
            "position_m": self.positions[where],
            "location": (float(sorted(self.positions).index(where)),),
            "locations": (float(len(self.positions)),),
        }

    def respond(
        self, run: Run, inputs: Mapping[str, Signal], theta: Array, forces: Sequence[Force], join: bool
    ) -> dict[str, Signal]:
        """See Twin."""
        m = len(self.outputs)
        used = {s: fold(inputs[s], theta) for s in self.inputs}
        tokens = tuple(used[s].token for s in self.inputs)
        out: dict[str, Signal] = {}
        for i, o in enumerate(self.outputs):
            key = ("cluster", o, tokens)
            a = remember(run.memo, key, lambda o=o: self._acceleration(o, used, run.dt))
            if join:
                out[o] = Signal(theta[i] + theta[m + i] * a, {}, (key, theta[i], theta[m + i]))
            else:
                out[o] = Signal(np.zeros_like(a), {i: np.ones_like(a), m + i: a}, (key,))
        return out

    def _acceleration(self, output: str, used: Mapping[str, Signal], dt: float) -> Array:
        axis = "xyz".index(output[-1])
        r = self.positions[location(output)]
        j, k = _NEXT[axis]
        a = used[f"specific_force_{output[-1]}"].value.copy()
        for rate_axis, arm, sign in ((j, r[k], 1.0), (k, r[j], -1.0)):
            rate = used.get(f"angular_rate_{'xyz'[rate_axis]}")
            if rate is not None and arm != 0.0:
                a += sign * arm * np.gradient(rate.value, dt, edge_order=2)
        return a

    def human(self, theta: Array) -> Sequence[Human]:
        """See Twin."""
        return [Human(p.name, float(v), p.unit) for p, v in zip(self.parameters, theta, strict=True)]

    def to_text(self, theta: Array) -> dict[str, object]:
        """See Twin. Bias and scale are optional keys of ours."""
        m = len(self.outputs)
        return {
            "positions_m": {k: list(v) for k, v in self.positions.items()},
            "bias": dict(zip(self.outputs, theta[:m].tolist(), strict=True)),
            "scale": dict(zip(self.outputs, theta[m:].tolist(), strict=True)),
        }


@dataclass(frozen=True)
class _Given(ClusterTwin):
    """Represents a cluster whose bias and scale were fitted before (a corrected twin)."""

    begin: tuple[float, ...] = ()

    def start(self, recording: Recording) -> Array:
        """See Twin."""
        return np.array(self.begin)


def location(output: str) -> str:
    """Return the location of an output: ``accel_3y`` -> ``3``."""
    match = re.fullmatch(r"accel_(\w*)[xyz]", output)
    assert match is not None
    return match[1]


def cluster_twin(recording: Recording) -> ClusterTwin:
    """Build the twin of a recording; locations without a given position are at the body origin."""
    text = recording.twin.parameters
    where = f"{recording.path}: [twin.parameters]"
    for key in text:
        if key not in names(PARAMETERS["accelerometer_cluster"]):
            raise RecordingError(f"{where} '{key}' is not a parameter of accelerometer_cluster; known: positions_m")
    given = text.get("positions_m", {})
    if not isinstance(given, Mapping):
        raise RecordingError(f'{where} positions_m must be a table such as {{ "1" = [x, y, z] }}')
    outputs = tuple(recording.outputs)
    positions: dict[str, tuple[float, float, float]] = {}
    for o in outputs:
        name = location(o)
        value = given.get(name, (0.0, 0.0, 0.0))
        r = np.asarray(value, np.float64) if _numbers(value) else np.zeros(0)
        if r.shape != (3,) or not np.all(np.isfinite(r)):
            raise RecordingError(f"{where} positions_m '{name}' must be three finite numbers in metres, got {value!r}")
        positions[name] = (float(r[0]), float(r[1]), float(r[2]))
    unit = "m/s^2"
    parameters = tuple(
        [Parameter(f"bias[{o}]", unit, scale=0.1) for o in outputs] + [Parameter(f"scale[{o}]", "1") for o in outputs]
    )
    inputs = tuple(recording.inputs)
    chain: tuple[Stage, ...] = ("mechanics", "mounting", "sensor", "environment", "acquisition")
    bias, scale = text.get("bias"), text.get("scale")
    if isinstance(bias, Mapping) or isinstance(scale, Mapping):
        bias, scale = bias or {}, scale or {}
        begin = [float(bias.get(o, 0.0)) for o in outputs] + [float(scale.get(o, 1.0)) for o in outputs]
        return _Given(
            recording.twin.kind, inputs, outputs, recording.unit, chain, parameters, positions, begin=tuple(begin)
        )
    return ClusterTwin(recording.twin.kind, inputs, outputs, recording.unit, chain, parameters, positions)


def _numbers(value: object) -> bool:
    return isinstance(value, Sequence) and all(isinstance(v, int | float) and not isinstance(v, bool) for v in value)
