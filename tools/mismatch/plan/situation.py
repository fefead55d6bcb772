"""Simulates a twin with its channels and rate, recorded or not, for a planned input."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from tools.errors import InputError, RecordingError
from tools.mismatch.engine.noise import NoiseFloor
from tools.mismatch.engine.problem import Problem
from tools.mismatch.engine.split import Split
from tools.mismatch.recording import Array, Recording
from tools.mismatch.recording_load import descriptor, from_table, load, load_twin
from tools.mismatch.simulate import Model
from tools.mismatch.twins.make import make
from tools.mismatch.twins.opaque import OpaqueTwin

PLACEHOLDERS = 64
"""Number of samples of the synthetic columns by which a description without data is checked."""

STANDARD: dict[str, tuple[tuple[str, str, str, str], ...]] = {
    "piezo_stack": (("command_V", "input", "command", "V"), ("displacement_um", "output", "displacement", "um")),
}
"""Channels of a twin file without a recording, for kinds that leave no choice: column, role, signal, unit."""


@dataclass(frozen=True)
class Situation:
    """Describes a twin for which a recording is planned.

    ``template`` is a recording with its channels, units and declared noise; ``recorded`` is True if its samples are
    measured and not synthetic.
    """

    path: Path
    template: Recording
    recorded: bool
    text: Mapping[str, Any]

    @property
    def dt(self) -> float:
        return self.template.dt

    def noise(self, output: str, floors: Mapping[str, float]) -> float:
        """Return the rms noise of an output: declared, or from ``floors``. Raises InputError if it is unknown."""
        found = self.template.noise.get(output) or floors.get(output)
        if not found:
            raise InputError(
                f"{self.path}: the noise of '{output}' is not known; add noise_rms to its channel, or --noise RMS"
            )
        return float(found)

    def course(self, inputs: Mapping[str, Array]) -> Recording:
        """Return a recording with these inputs (n,), the others at rest, and outputs that are not simulated yet.

        The outputs are a ramp, because a record whose inputs and outputs repeat counts as one in steady state, and this
        one begins at rest.
        """
        n = next(iter(inputs.values())).size
        old = self.template
        rest = {s: np.full(n, float(np.mean(x)) if self.recorded else 0.0) for s, x in old.inputs.items()}
        return replace(
            old,
            t=np.asarray(np.arange(n) * old.dt, np.float64),
            inputs={**rest, **inputs},
            outputs={o: np.linspace(0.0, 1.0, n) for o in old.outputs},
            context={s: np.resize(x, n) for s, x in old.context.items()},
            segments=(),
            split=type(old.split)(),
        )


def situation(path: Path, noise: float | None = None, rate_hz: float | None = None) -> Situation:
    """Load the situation that ``path`` describes.

    ``path`` is a recording, a ``recording.toml`` without ``data``, or a twin file of a kind with standard channels.
    Raises InputError or RecordingError that says what is missing.
    """
    file = path / "recording.toml" if path.is_dir() else path
    text = descriptor(file)
    if "channels" not in text and isinstance(text.get("twin"), Mapping):
        text, twin = _standard(file, text, noise, rate_hz), load_twin(file)
        made = from_table(file, text, _placeholders(text), twin)
        return Situation(path, made, False, text)
    if "data" in text:
        return Situation(path, load(file), True, text)
    if "rate_hz" not in text:
        raise RecordingError(f"{file}: has neither data nor rate_hz; say at which rate it is to be recorded")
    return Situation(path, _without_data(file, text), False, text)


def _standard(file: Path, text: Mapping[str, Any], noise: float | None, rate_hz: float | None) -> dict[str, Any]:
    kind = text["twin"].get("kind")
    if kind not in STANDARD:
        raise InputError(
            f"{file}: a {kind} has no standard channels; give a recording.toml with [[channels]] and rate_hz, and "
            f'[twin] file = "{file.name}" (it needs no data)'
        )
    channels: list[dict[str, Any]] = [
        dict(zip(("column", "role", "signal", "unit"), c, strict=True)) for c in STANDARD[kind]
    ]
    for channel in channels:
        if channel["role"] == "output" and noise is not None:
            channel["noise_rms"] = noise
    return {"format": 1, "rate_hz": rate_hz or 1000.0, "twin": text["twin"], "channels": channels}


def _placeholders(text: Mapping[str, Any]) -> dict[str, Array]:
    wave: Array = np.sin(np.linspace(0.0, 20.0, PLACEHOLDERS))
    names = [str(c.get("column", "")) for c in text["channels"] if isinstance(c, Mapping)]
    return {name: wave * (1.0 + 0.1 * i) for i, name in enumerate(names)}


def _without_data(file: Path, text: Mapping[str, Any]) -> Recording:
    channels = text.get("channels")
    if not isinstance(channels, list):
        raise RecordingError(f"{file}: [[channels]] must be a list of tables")
    return from_table(file, text, _placeholders(text))


def problem_of(recording: Recording, sigma: Mapping[str, float], seed: int = 0) -> Problem:
    """Return a problem whose fit is the whole recording, at stated noise."""
    twin, n = make(recording), recording.n
    if isinstance(twin, OpaqueTwin):
        raise InputError(
            f"{recording.path}: a {twin.kind} twin is a program whose inside cannot be seen; "
            "plan needs a twin of equations, a state space or a sensor"
        )
    split = Split(n, ((0, n),), (), (), ((0, n),))
    floors = {o: NoiseFloor(s, 0.0, s, 0.0, "declared", False) for o, s in sigma.items()}
    return Problem(recording, twin, split, 0, seed, floors)


def with_outputs(recording: Recording, outputs: Mapping[str, Array]) -> Recording:
    """Return the recording with these outputs (n,)."""
    return replace(recording, outputs=dict(outputs))


def simulated(recording: Recording, model: Model, theta: Array) -> dict[str, Array]:
    """Return the outputs (n,) of a model over a whole recording; a twin with states begins at rest."""
    from tools.mismatch.simulate_view import View

    with np.errstate(all="ignore"):
        return model.simulate(View.whole(recording), theta)


def noisy(outputs: Mapping[str, Array], sigma: Mapping[str, float], rng: np.random.Generator) -> dict[str, Array]:
    """Return the outputs with independent normal noise."""
    return {o: y + sigma[o] * rng.standard_normal(y.size) for o, y in outputs.items()}
