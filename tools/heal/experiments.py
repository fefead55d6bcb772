"""The twin of a stack that differs from what the firmware believes: recorded, diagnosed, and recorded again as planned.

Where the diagnosis ends with effects that it cannot tell apart, the input that splits them is planned within the limits
of the bench, played on the stack, and both recordings get one diagnosis. The corrected twin is written beside them.
"""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path

from sim_devices.plant.lab import in_place, measure_piezo, measure_volts, write_recording
from tools.errors import InputError, RecordingError
from tools.heal.parts import AMPLITUDE_V, CHECK_S, PROFILES, Lab
from tools.mismatch.apply import corrected_twin
from tools.mismatch.infer import diagnose
from tools.mismatch.plan.limits import bench_limits
from tools.mismatch.plan.plan import Asked, plan_for
from tools.mismatch.plan.rivals import groups_of
from tools.mismatch.plan.write import write_plan
from tools.mismatch.recording_load import load
from tools.mismatch.together import load_together
from tools.output import write_text_atomic

EVALUATIONS = 40
"""Inputs that are tried for a planned experiment."""


@dataclass(frozen=True)
class StackTwin:
    """Describes the corrected twin of stack ``axis`` (from 0).

    ``file`` is None if it could not be written; ``effects`` are those in it; ``split`` is the group for which an
    experiment was planned and played, empty if none was needed.
    """

    axis: int
    file: Path | None
    effects: tuple[str, ...]
    split: tuple[str, ...]


def twin_of_stack(lab: Lab, axis: int) -> StackTwin:
    """Record stack ``axis``, diagnose it, and write ``twin-stack<N>.toml`` beside the recordings."""
    home = lab.folder / f"stack{axis + 1}"
    profile, rate_hz = PROFILES[0]
    replaced = in_place(lab.config, lab.bench.path, axis, None)
    first = home / "first"
    write_recording(first, *measure_piezo(lab.config, axis, profile, rate_hz, CHECK_S, AMPLITUDE_V, twin=replaced))
    report = diagnose(load(first), jobs=1).to_json()
    groups = groups_of(report)
    split: tuple[str, ...] = ()
    if groups:
        asked = Asked(evaluations=EVALUATIONS, bench=bench_limits(lab.bench))
        try:
            designed = plan_for(first, report, asked)
        except InputError:
            pass  # no rival could be fitted: the first recording is all that there is
        else:
            write_plan(designed.plan, designed.where, home / "plan", (axis + 1,))
            volts = next(iter(designed.plan.waves.values()))
            planned = home / "planned"
            columns = measure_volts(
                lab.config, axis, volts, 1.0 / designed.plan.dt, noise="planned", what="as planned", twin=replaced
            )
            write_recording(planned, *columns)
            report = diagnose(load_together([first, planned]), jobs=1).to_json()
            split = designed.group
    write_text_atomic(home / "report.json", json.dumps(report))
    effects = tuple(str(p["name"]) for p in report["physics"])
    file = lab.folder.parent / f"twin-stack{axis + 1}.toml"
    try:
        write_text_atomic(file, corrected_twin(first, report).text)
    except (InputError, RecordingError):
        return StackTwin(axis, None, effects, split)
    return StackTwin(axis, file, effects, split)
