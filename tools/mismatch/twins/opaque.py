"""Wraps foreign programs as twins: Python objects from an entry point, FMUs, the emulated instrument.

Their inside is unknown: effects sit at inputs and outputs only; base parameters are the numbers in
``[twin.parameters]``, all of which are searched, because none is known to be linear.
"""

from __future__ import annotations

import sys
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from hashlib import blake2b
from typing import Any, Protocol

import numpy as np

from hal import plugins
from hal.trust import require_package
from sim_devices.physics.effect import STAGES, Array, Human, Parameter, Stage
from tools.errors import RecordingError
from tools.guest.host import GuestError, GuestProcess
from tools.mismatch.recording import Recording, Simulate
from tools.mismatch.twins.base import Counted, Force, Run, Signal, fold
from tools.mismatch.twins.holds import Holds
from tools.mismatch.twins.linear import Hold
from tools.mismatch.twins.memo import remember


class UserTwin(Protocol):
    """Defines the object (or class) that an entry point of group ``micron.twins`` must return.

    ``inputs``: each input (n,) by name, and ``t`` in seconds (n,). ``parameters``: the ``[twin.parameters]`` table.
    Result: each output (n,) by name.
    """

    def simulate(self, inputs: Mapping[str, Array], parameters: Mapping[str, Any]) -> Mapping[str, Array]:
        """Make a free run."""
        ...


SMALL = 0.01
"""Size of a change whose effect is a difference of two runs, as a share of the range of the input: solvers of foreign
programs are exact to 1e-4 or so."""

Call = Callable[[Mapping[str, Array], Mapping[str, Any]], Mapping[str, Array]]


@dataclass(frozen=True)
class OpaqueTwin:
    """Wraps a function as a twin. ``free``: parameters that may be re-fitted, ``fixed``: the others."""

    kind: str
    inputs: tuple[str, ...]
    outputs: tuple[str, ...]
    units: Mapping[str, str]
    call: Call
    free: tuple[str, ...]
    given: Mapping[str, Any]
    parameters: tuple[Parameter, ...]
    chain: tuple[Stage, ...] = STAGES
    static: bool = False
    apart: bool = False
    restart: bool = False
    feedback_on: str = ""
    counted: Counted = ""
    source: str = field(default="", compare=False)
    holds: Holds = field(default_factory=dict[str, Hold])
    """Hold of the inputs, the same for each, that the program is told; empty: it is not told."""

    def start(self, recording: Recording) -> Array:
        """See Twin."""
        return np.array([float(self.given[k]) for k in self.free])

    def drive(self, output: str) -> str:
        """See Twin."""
        return self.inputs[0] if len(self.inputs) == 1 else ""

    def facts(self, output: str) -> Mapping[str, tuple[float, ...]]:
        """See Twin."""
        return {}

    def sensitivity(self, output: str, theta: Array) -> float:
        """See Twin: unknown."""
        return 1.0

    def input_gain(self, signal: str, theta: Array) -> float:
        """See Twin."""
        return 1.0

    def through(self, run: Run, signal: str, theta: Array, output: str) -> Callable[[Array], Array] | None:
        """See Twin: the inside is unknown, so a change is carried by the difference of two runs."""
        if signal not in self.inputs:
            return None
        held = {s: Signal(run.signals[s], {}, (s,)) for s in self.inputs}
        u, row = run.signals[signal], self.outputs.index(output)
        here, small = self._simulated(run, held, theta)[row], SMALL * (float(np.ptp(u)) or 1.0)

        def carry(change: Array) -> Array:
            most = float(np.max(np.abs(change)))
            if not 0.0 < most < np.inf:
                return np.zeros_like(change)
            share = small / most
            token = (signal, "moved", blake2b(change.tobytes()).digest())
            try:
                moved = self._simulated(run, held | {signal: Signal(u + share * change, {}, token)}, theta)[row]
            except RecordingError:
                return np.zeros_like(change)
            return np.nan_to_num((moved - here) / share, nan=0.0, posinf=0.0, neginf=0.0)

        return carry

    def respond(
        self, run: Run, inputs: Mapping[str, Signal], theta: Array, forces: Sequence[Force], join: bool
    ) -> dict[str, Signal]:
        """See Twin."""
        used = {s: fold(x, theta) for s, x in inputs.items()}
        stacked, key = self._simulated(run, used, theta), self._key(used, theta)
        return {o: Signal(stacked[i], {}, (key, o)) for i, o in enumerate(self.outputs)}

    def _values(self, theta: Array) -> dict[str, Any]:
        return dict(self.given) | {k: float(v) for k, v in zip(self.free, theta, strict=False)}

    def _key(self, used: Mapping[str, Signal], theta: Array) -> tuple[object, ...]:
        values = self._values(theta)
        return ("opaque", tuple(x.token for x in used.values()), tuple(values[k] for k in self.free))

    def _simulated(self, run: Run, used: Mapping[str, Signal], theta: Array) -> Array:
        """Return the outputs (outputs, n) of a run with the inputs ``used``; NaN if the program refuses ``theta``."""
        values = self._values(theta)
        as_given = all(values[k] == float(self.given[k]) for k in self.free)

        def make() -> Array:
            try:
                return self._checked(self.call({s: x.value for s, x in used.items()} | {"t": run.t}, values), run.t)
            except RecordingError:
                if as_given:
                    raise
                # the valid values of a foreign program are unknown; a search that leaves them is reversed
                return np.full((len(self.outputs), run.t.size), np.nan)

        return remember(run.memo, self._key(used, theta), make)

    def _checked(self, found: Mapping[str, Array], t: Array) -> Array:
        """Return outputs (outputs, n). Raises RecordingError if one is missing, not finite or not as long as ``t``."""
        rows: list[Array] = []
        for o in self.outputs:
            if o not in found:
                raise RecordingError(f"twin '{self.kind}' ({self.source}) returned no output '{o}'")
            y = np.asarray(found[o], np.float64)
            if y.shape != t.shape:
                raise RecordingError(
                    f"twin '{self.kind}' ({self.source}): output '{o}' has shape {y.shape}, expected {t.shape}"
                )
            if not np.all(np.isfinite(y)):
                i = int(np.argmin(np.isfinite(y)))
                raise RecordingError(f"twin '{self.kind}' ({self.source}): output '{o}' is {y[i]} at sample {i}")
            rows.append(y)
        return np.stack(rows)

    def human(self, theta: Array) -> Sequence[Human]:
        """See Twin."""
        return [Human(k, float(v), "") for k, v in zip(self.free, theta, strict=True)]

    def to_text(self, theta: Array) -> dict[str, object]:
        """See Twin."""
        out: dict[str, object] = dict(self.given)
        return out | {k: float(v) for k, v in zip(self.free, theta, strict=True)}


def opaque_twin(recording: Recording, call: Call, source: str, fixed: Sequence[str] = ()) -> OpaqueTwin:
    """Return the numbers in ``[twin.parameters]`` that may be re-fitted: all but the names in ``fixed``."""
    given = recording.twin.parameters
    free = tuple(
        k for k, v in given.items() if isinstance(v, int | float) and not isinstance(v, bool) and k not in fixed
    )
    parameters = tuple(Parameter(k, "", scale=0.01 * abs(float(given[k])) or 1e-3) for k in free)
    return OpaqueTwin(
        recording.twin.kind,
        tuple(recording.inputs),
        tuple(recording.outputs),
        recording.unit,
        call,
        free,
        given,
        parameters,
        source=source,
    )


def function_twin(recording: Recording, simulate: Simulate) -> OpaqueTwin:
    """Build the twin of a function that runs in this process."""
    call = FunctionRun(simulate, recording.dt, tuple(recording.inputs), tuple(recording.outputs))
    return opaque_twin(recording, call, getattr(simulate, "__name__", "simulate"), recording.twin.fixed)


@dataclass(frozen=True)
class FunctionRun:
    """Makes a free run of a function per call. Raises RecordingError with the function's own exception."""

    simulate: Simulate
    dt: float
    inputs: tuple[str, ...]
    outputs: tuple[str, ...]

    def __call__(self, inputs: Mapping[str, Array], parameters: Mapping[str, Any]) -> Mapping[str, Array]:
        name = getattr(self.simulate, "__name__", "simulate")
        try:
            # copies protect the engine's arrays
            found = self.simulate({s: inputs[s].copy() for s in self.inputs}, dict(parameters), self.dt)
        except Exception as error:
            raise RecordingError(f"{name}(inputs, parameters, dt) failed: {type(error).__name__}: {error}") from error
        if isinstance(found, Mapping):
            return found
        if len(self.outputs) > 1:
            raise RecordingError(f"{name} returned one array; return each of {', '.join(self.outputs)} by name")
        return dict.fromkeys(self.outputs, np.asarray(found))


def user_twin(recording: Recording, entry: Any) -> OpaqueTwin:
    """Build the twin of an entry point (a ``UserTwin`` or its class) in a process of its own. Raises ``NotTrusted``."""
    target = str(entry.value)
    require_package(target, recording.path)
    request = {"ask": "open_entry", "name": entry.name, "value": target, "group": plugins.TWINS}
    guest = GuestProcess(f"twin '{recording.twin.kind}' ({target})", {**request, "import_path": sys.path})
    try:
        guest.opened()
    except GuestError as error:
        raise RecordingError(
            f"{recording.path}: [twin] kind '{recording.twin.kind}' cannot be loaded from {target}: {error}"
        ) from error

    return opaque_twin(recording, PackagedRun(guest), target)


@dataclass(frozen=True)
class PackagedRun:
    """Makes a free run of an entry point's twin per call."""

    guest: GuestProcess

    def __call__(self, inputs: Mapping[str, Array], parameters: Mapping[str, Any]) -> Mapping[str, Array]:
        try:
            return self.guest.run(inputs, parameters)
        except GuestError as error:
            raise RecordingError(f"{self.guest.name} failed: {error.kind}: {error}") from error
