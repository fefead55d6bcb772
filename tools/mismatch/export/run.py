"""Loads and runs a twin: that of a recording (``simulate_own``), or one of any kind of file (``simulate_file``)."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from hal.trust import trusted_program
from sim_devices.physics.effect import Array
from tools.errors import RecordingError
from tools.guest.host import GuestError, GuestProcess
from tools.mismatch import units
from tools.mismatch.export.linear_text import linear_lines
from tools.mismatch.keys import PARAMETERS, names
from tools.mismatch.recording import Recording
from tools.mismatch.recording_load import load, load_twin
from tools.mismatch.report.wording import percent
from tools.mismatch.simulate import Model
from tools.mismatch.simulate_view import View, view_run
from tools.mismatch.twins.base import Signal
from tools.mismatch.twins.fmu import FmuRun, with_equations
from tools.mismatch.twins.holds import declared_holds
from tools.mismatch.twins.make import make
from tools.mismatch.twins.ode import OdeTwin
from tools.numbers import rms

KINDS = (".toml", ".py", ".fmu")
CHECK = "check units, signs and offsets (where a plant integrates, small errors add up)"
LEAST_OFFSET = 0.9
"""Ratio of the scatter to the rms of a residual below which its mean is printed as well."""


@dataclass(frozen=True)
class Residual:
    """Holds the rms of recorded minus simulated of an output, in the unit of the file.

    ``scatter`` is the rms about the mean ``mean``. ``where`` names the samples; ``share`` is the rms over that of the
    recorded output less its mean (None if it is constant).
    """

    output: str
    unit: str
    rms: float
    scatter: float
    mean: float
    where: str
    share: float | None

    def as_dict(self) -> dict[str, object]:
        """Return the row of the command's JSON."""
        return asdict(self)

    def text(self) -> str:
        """Return the row as a sentence; the scatter is in it where a constant offset is a notable part of the rms."""
        line = f"{self.output}: residual {self.rms:.4g} {self.unit} rms{self.where}"
        if self.scatter < LEAST_OFFSET * self.rms:
            line += f" ({self.scatter:.4g} {self.unit} about its mean of {self.mean:.4g} {self.unit})"
        if self.share is None:
            return line
        line += f", {percent(self.share)} of the recording's standard deviation"
        return line if self.share <= 1.0 else f"{line}: its mean alone would be closer; {CHECK}"


def residuals(recording: Recording, found: Mapping[str, Array]) -> list[Residual]:
    """Return the residual of each output over the whole recording, and over its test range if ``[split]`` has one."""
    rows: list[Residual] = []
    parts = {"": (0, recording.n)}
    test = recording.split.test
    if isinstance(test, tuple):
        parts[f" on samples {test[0]} to {test[1]}"] = test
    for o, y in found.items():
        recorded = units.convert(recording.outputs[o], recording.unit[o], recording.file_unit[o])
        for where, (a, b) in parts.items():
            e, moved = (recorded - y)[a:b], float(np.std(recorded[a:b]))
            share = rms(e) / moved if moved > 0.0 else None
            rows.append(Residual(o, recording.file_unit[o], rms(e), float(np.std(e)), float(np.mean(e)), where, share))
    return rows


def as_read(recording: Recording) -> list[str]:
    """Return what was read of a recording, as lines: twin, clock, signals, holds where its kind has one, parameters,
    poles and static gains of matrices, notes.
    """
    holds = declared_holds(recording)
    has_hold = "hold" in names(PARAMETERS.get(recording.twin.kind, ()))
    named = lambda of: ", ".join(f"{s} ({recording.file_unit[s]})" for s in of)  # noqa: E731
    hold = {
        s: f", hold {holds.get(s, 'not given, straight')}" if has_hold or s in holds else "" for s in recording.inputs
    }
    held = ", ".join(f"{s} ({recording.file_unit[s]}{hold[s]})" for s in recording.inputs)
    runs = f" in {len(recording.segments) + 1} runs" if recording.segments else ""
    lines = [
        f"twin: {recording.twin.kind}",
        f"samples: {recording.n}{runs} at {1 / recording.dt:g} Hz, {recording.n * recording.dt:g} s",
        f"inputs: {held}",
        f"outputs: {named(recording.outputs)}",
    ]
    if recording.context:
        lines.append(f"other signals: {named(recording.context)}")
    given = {
        k: v for k, v in recording.twin.parameters.items() if isinstance(v, int | float) and not isinstance(v, bool)
    }
    if given:
        lines.append("parameters: " + ", ".join(f"{k} = {v:.6g}" for k, v in given.items()))
    return [*lines, *linear_lines(recording), *(f"note: {note}" for note in recording.warnings)]


def start_of(recording: Recording) -> str:
    """Return the states of a twin with equations at the first sample, as a line; empty for other twins."""
    recording = with_equations(recording)
    twin = make(recording)
    if not isinstance(twin, OdeTwin) or not twin.has_states:
        return ""
    run = view_run(twin, whole_view(recording, Model(twin)))
    inputs = {s: Signal(run.signals[s], {}, (s,)) for s in recording.inputs}
    x = twin.states(run, inputs, twin.start(recording), ())[0][0]
    return "states at the first sample: " + ", ".join(
        f"{s.name} = {v:.4g} {s.unit}".rstrip() for s, v in zip(twin.state_list, x.tolist(), strict=True)
    )


def simulate_own(recording: Recording) -> dict[str, Array]:
    """Return the outputs (n,) of the twin that a recording names, in a free run and in the units of its file."""
    found = free_run(with_equations(recording))
    return {o: units.convert(y, recording.unit[o], recording.file_unit[o]) for o, y in found.items()}


def simulate_file(twin: Path | str, recording: Path | str | Recording) -> dict[str, Array]:
    """Return the outputs (n,) of a twin over a whole recording, by signal, in the units of the recording's file.

    ``twin`` is a file of ``micron mismatch apply`` (.toml, .py or .fmu). It runs freely: measured outputs set only the
    state at the first samples of a .toml twin with states; a .py twin has its written start state. Raises
    RecordingError for a fault of either file.
    """
    path, rec = Path(twin), recording if isinstance(recording, Recording) else load(recording)
    if not path.is_file():
        raise RecordingError(f"{path}: no such twin; give a file that 'micron mismatch apply' wrote")
    match path.suffix.lower():
        case ".toml":
            rec = with_equations(rec)
            other = replace(rec, twin=load_twin(path))
            if other.twin.kind != rec.twin.kind:
                raise RecordingError(
                    f"{path} is a {other.twin.kind} and {rec.path} describes a {rec.twin.kind}; give one of that kind"
                )
            return simulate_own(other)
        case ".py":
            return _of(path, rec, _run_module(path, rec))
        case ".fmu":
            return _run_fmu(path, rec)
        case suffix:
            raise RecordingError(f"{path}: the ending '{suffix}' is no twin; it must be one of {', '.join(KINDS)}")


def free_run(recording: Recording) -> dict[str, Array]:
    """Return the outputs (n,) of the twin that a recording names, in its own units, of a free run over all samples."""
    twin = make(recording)
    return whole_run(recording, Model(twin), twin.start(recording))


def whole_run(recording: Recording, model: Model, theta: Array) -> dict[str, Array]:
    """Return the outputs (n,) of a model in a free run; the first samples that a diagnosis would use set its state."""
    return model.simulate(whole_view(recording, model), theta)


def whole_view(recording: Recording, model: Model) -> View:
    """Return the whole recording as a free run whose state is set by the first samples that a diagnosis would use."""
    from tools.mismatch.engine.pose import free_run as course

    init = recording.split.initialization or course(recording, model.twin)[1]
    return View(recording, ((0, recording.n),), init)


def in_file_units(recording: Recording) -> dict[str, Array]:
    """Return inputs and context signals (n,) in the units of the data file."""
    return {s: units.convert(x, recording.unit[s], recording.file_unit[s]) for s, x in recording.signals.items()}


def _run_module(path: Path, recording: Recording) -> dict[str, Array]:
    """Return the outputs of ``simulate`` of a Python twin, run in a process of its own."""
    source = trusted_program(path, path).decode("utf-8-sig", "replace")
    opening = {"ask": "open_module", "path": str(path), "source": source, "dt": recording.dt}
    guest = GuestProcess(str(path), opening)
    try:
        guest.opened()
    except GuestError as error:
        raise RecordingError(
            f"{path}: cannot be imported ({error.kind}: {error}); write one with 'micron mismatch apply'"
        ) from error
    try:
        return guest.run(in_file_units(recording), {})
    except GuestError as error:
        raise RecordingError(f"{path}: simulate() failed ({error.kind}: {error})") from error
    finally:
        guest.end()


def _run_fmu(path: Path, recording: Recording) -> dict[str, Array]:
    """Return the outputs (n,) of an FMU in the units of the recording's file; the FMU uses the recording's own."""
    fmu = FmuRun(path, tuple(recording.outputs), recording.dt)
    known = fmu.names()
    signals = {s: x for s, x in recording.signals.items() if s in known}
    lost = [s for s in (*recording.inputs, *recording.outputs) if s not in known]
    if lost:
        raise RecordingError(
            f"{path}: the FMU has no variable {', '.join(lost)}; name the recording's signals as its variables"
        )
    found = fmu({**signals, "t": recording.t}, {"hold": "end"})
    return {o: units.convert(np.asarray(y), recording.unit[o], recording.file_unit[o]) for o, y in found.items()}


def _of(path: Path, recording: Recording, found: Mapping[str, Any]) -> dict[str, Array]:
    """Return the outputs of the recording among those that a twin returned."""
    lost = [o for o in recording.outputs if o not in found]
    if lost:
        raise RecordingError(f"{path}: returned no output {', '.join(lost)}; it gives {', '.join(found) or 'none'}")
    return {o: np.asarray(found[o], np.float64) for o in recording.outputs}
