"""Writes a corrected twin in the format of the file's extension: .toml, .py, .fmu or .csv."""

from __future__ import annotations

import csv
import io
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from hal.trust import allow_name, trust_program
from sim_devices.physics.effect import Array
from tools.errors import InputError
from tools.mismatch import units
from tools.mismatch.apply import Corrected
from tools.mismatch.export.module import python_module
from tools.mismatch.export.run import in_file_units, whole_run, whole_view
from tools.mismatch.placed import Placed
from tools.mismatch.recording import Recording
from tools.mismatch.report.wording import scaled
from tools.mismatch.simulate import Model
from tools.mismatch.twins.cascade import CascadeTwin
from tools.mismatch.twins.dynamic import DynamicTwin
from tools.mismatch.twins.ode import OdeTwin
from tools.output import write_text_atomic

FORMATS = {
    ".toml": "the twin file, which recordings, benches and 'micron mismatch simulate' take",
    ".py": "a Python module that needs numpy alone",
    ".fmu": "an FMI 2.0 co-simulation (needs PythonFMU)",
    ".csv": "inputs, recorded and simulated outputs, in columns",
}
START_SAMPLES = 400  # number of samples of the engine's run to which the start state of a module is fitted


def check_format(out: Path) -> None:
    """Raise InputError for a file name without a known extension, or a format that cannot be written here."""
    if out.suffix.lower() not in FORMATS:
        known = "; ".join(f"{k}: {v}" for k, v in FORMATS.items())
        raise InputError(f"{out}: the ending says the format, and '{out.suffix}' is none ({known})")
    if out.suffix.lower() == ".fmu":
        from tools.mismatch.export.fmu import check_pythonfmu

        check_pythonfmu()


def write_twin(twin: Corrected, report: Mapping[str, Any], out: Path) -> None:
    """Write ``twin`` to ``out``. Raises InputError if its kind or its effects do not allow the format."""
    check_format(out)
    match out.suffix.lower():
        case ".toml":
            write_text_atomic(out, twin.text)
        case ".py":
            write_text_atomic(out, module_of(twin, report))
        case ".fmu":
            from tools.mismatch.export.fmu import write_fmu

            write_fmu(twin, module_of(twin, report), out)
        case _:
            found = whole_run(twin.recording, twin.model, twin.theta)
            to = {o: twin.recording.file_unit[o] for o in found}
            simulated = {o: units.convert(y, twin.recording.unit[o], to[o]) for o, y in found.items()}
            write_text_atomic(out, columns(twin.recording, simulated))
    allow_name(out)
    if out.suffix.lower() in (".py", ".fmu"):
        trust_program(out)  # this program wrote it, from equations


def module_of(twin: Corrected, report: Mapping[str, Any]) -> str:
    """Return the twin as a Python module with the start state of the recording."""

    def text(part: Corrected, start: Array) -> str:
        rec = part.recording
        return python_module(rec, part.model, part.theta, rec.file_unit, _report_lines(report), start)

    if isinstance(twin.model.twin, OdeTwin):
        return text(twin, twin.model.start_states(whole_view(twin.recording, twin.model), twin.theta))
    order = order_of(twin)
    if order == 0:
        return text(twin, np.zeros(0))
    # effects behind the states do not set them, and forces are small over a few samples
    free = [part_of(twin, [pl for pl in twin.model.placed if pl.site in sites]) for sites in (FORCED, ("input",))]
    run, linear = (runnable(text(part, np.zeros(order))) for part in free)
    return text(twin, start_state(run, linear, twin, order))


FORCED = ("input", "feedback")


def part_of(twin: Corrected, placed: Sequence[Placed]) -> Corrected:
    """Return the twin with some of its effects."""
    model = Model(twin.model.twin, placed)
    return replace(twin, model=model, theta=model.carry(twin.model, twin.theta, twin.recording))


def runnable(module: str) -> Any:
    """Return ``simulate`` of the text of a module."""
    space: dict[str, Any] = {}
    exec(compile(module, "twin.py", "exec"), space)
    return space["simulate"]


def order_of(twin: Corrected) -> int:
    """Return the number of states of the text of a twin."""
    core = twin.model.twin
    if isinstance(core, CascadeTwin):
        return len(np.asarray(core.to_text(twin.theta)["A"]))
    if not isinstance(core, DynamicTwin):
        return 0
    a = core.to_text(twin.theta).get("A", np.eye(2))  # a mechanical axis has position and velocity
    return len(np.asarray(a))


def start_state(run: Any, linear: Any, twin: Corrected, order: int) -> Array:
    """Fit the state (order,) from which ``run`` reproduces the engine's own free run in front of effects at outputs.

    ``linear`` is the run without forces, whose response to a change of the state is known.
    """
    rec = twin.recording
    wanted = twin.model.in_front(whole_view(rec, twin.model), twin.theta)
    scale = {o: float(np.std(y)) or 1.0 for o, y in wanted.items()}
    signals = in_file_units(rec)

    def outputs(simulate: Any, start: Array, m: int) -> Array:
        found = simulate({s: x[:m] for s, x in signals.items()}, {"start": start}, rec.dt)
        rows = [units.convert(np.asarray(found[o]), rec.file_unit[o], rec.unit[o]) / scale[o] for o in wanted]
        return np.concatenate(rows)

    def solve(columns: Array, away: Array) -> Array:
        size = np.linalg.norm(columns, axis=0)
        size[size == 0.0] = 1.0
        return np.linalg.lstsq(columns / size, away, rcond=1e-11)[0] / size

    def better(x: Array, m: int, columns_at: Any, turns: int) -> Array:
        aim = np.concatenate([y[:m] / scale[o] for o, y in wanted.items()])
        best, left = x, aim - outputs(run, x, m)
        for _ in range(turns):
            columns = columns_at(best, m)
            if not np.all(np.isfinite(columns)) or not np.all(np.isfinite(left)):
                break
            x = best + solve(columns, left)
            away = aim - outputs(run, x, m)
            if not np.linalg.norm(away) < np.linalg.norm(left):
                break
            best, left = x, away
        return best

    def without_forces(x: Array, m: int) -> Array:
        rest = outputs(linear, np.zeros(order), m)
        return np.stack([outputs(linear, e, m) - rest for e in np.eye(order)], axis=1)

    def differences(x: Array, m: int) -> Array:
        step = 1e-6 * np.maximum(np.abs(x), float(np.max(np.abs(x), initial=0.0)) or 1.0)
        here = outputs(run, x, m)
        return np.stack([(outputs(run, x + h * e, m) - here) / h for h, e in zip(step, np.eye(order), strict=True)], 1)

    x = np.zeros(order)
    for m in (2 * order + 2, 6 * order, START_SAMPLES):
        x = better(x, min(m, rec.n), without_forces, 20)
        x = better(x, min(m, rec.n), differences, 6)
    return x


def _report_lines(report: Mapping[str, Any]) -> list[str]:
    """Return the report's lines on each effect, under its own names and units."""
    lines: list[str] = []
    for p in report.get("physics", []):
        values = [
            f"{n} {_figure(v['value'])} ({_figure(v['ci95'][0])} .. {_figure(v['ci95'][1])}) {v['unit']}"
            for n, v in p.get("parameters", {}).items()
        ]
        if values:
            lines.append(f"report   {p['name']}: {', '.join(values)}")
    fit = report.get("fit", {})
    for o, v in fit.get("fitted_rms", {}).items():
        base = fit.get("base_rms", {}).get(o)
        factor, unit = scaled(v, fit["unit"][o], fit.get("file_unit", {}).get(o, ""))
        given = _figure(None if base is None else factor * base)
        lines.append(f"residual on held-out data, {o}: {_figure(factor * v)} {unit} (twin as given: {given})")
    return lines


def _figure(value: object) -> str:
    return f"{value:.4g}" if isinstance(value, int | float) else "-"


def columns(recording: Recording, simulated: Mapping[str, Array]) -> str:
    """Return a csv of time, inputs, recorded and simulated outputs, in the units and names of the data file."""
    found = in_file_units(recording)
    measured = {o: units.convert(y, recording.unit[o], recording.file_unit[o]) for o, y in recording.outputs.items()}
    table = {recording.column[s]: found[s] for s in recording.inputs}
    table |= {recording.column[o]: y for o, y in measured.items()}
    table |= {f"{recording.column[o]}_simulated": y for o, y in simulated.items()}
    # a time in steps of 0.05 s is written as such
    return _csv(["t_s", *table], [np.round(recording.t, 12), *table.values()])


def _csv(header: Sequence[str], values: Sequence[Array]) -> str:
    out = io.StringIO()
    writer = csv.writer(out, lineterminator="\n")
    writer.writerow(header)
    writer.writerows(zip(*(v.tolist() for v in values), strict=True))
    return out.getvalue()
