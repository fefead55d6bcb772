"""Runs the same stages over the recorded inputs and compares estimates and commands with the recording bit for bit."""

from __future__ import annotations

from typing import Any, cast

import numpy as np
from numpy.typing import NDArray

from firmware_py.control.stages import StageConfigs, Stages
from firmware_py.frame import ACCELEROMETER_MORE, LAYOUT, PARITIES, PARITY, VOLTS
from firmware_py.recording.errors import RecordingError
from firmware_py.recording.format import load_json
from firmware_py.recording.reader import Recording
from firmware_py.recording.replay import ReplayReport, replay

_NAMES = LAYOUT.scalar_names()
"""Columns that a replay must reproduce. It is given the other columns, the commands chosen by hand, and the status bits
that the loop set."""
LATER_COLUMNS = _NAMES[ACCELEROMETER_MORE : PARITY + len(PARITIES)]
"""Columns that older recordings lack. Such a recording is compared in its other columns."""


def recorded_configs(recording: Recording) -> StageConfigs:
    """Return the configuration that the run was made with. Raises ``RecordingError`` when the recording has none."""
    text = recording.metadata.get("stages")
    if not isinstance(text, str):
        raise RecordingError(f"{recording.path}: no stage configuration in its metadata; only runs can be replayed")
    try:
        loaded: object = load_json(text)
    except RecordingError as error:
        raise RecordingError(f"{recording.path}: its stage configuration cannot be read: {error}") from error
    tables = cast("dict[str, Any]", loaded)
    if not isinstance(loaded, dict) or not all(isinstance(table, dict) for table in tables.values()):
        raise RecordingError(f"{recording.path}: its stage configuration is not a table for every stage")
    # a recording that does not name one of these was made before there was such a thing
    adaptive: dict[str, Any] = tables.setdefault("tremor", {}).setdefault("adaptive", {})
    adaptive.setdefault("quiet", 0.0)
    adaptive.setdefault("ease_s", 0.0)
    adaptive.setdefault("relative", 0.0)
    adaptive.setdefault("above", 1.0)
    adaptive.setdefault("relative_powers", (1.0, 0.5))
    actuation = tables.setdefault("actuation", {})
    actuation.setdefault("overdrive", 0.0)
    actuation.setdefault("overdrive_tilts", False)
    actuation.setdefault("overdrive_tilt", actuation["overdrive"])
    actuation.setdefault("yield_attack_s", 0.0)
    actuation.setdefault("centring", 0.0)
    sensing = tables.setdefault("sensing", {})
    sensing.setdefault("kinematics_guard", False)
    sensing.setdefault("hand_swing_s", 0.0)
    sensing.setdefault("heading_tilts", False)
    return StageConfigs.from_dict(tables, str(recording.path))


def replay_micron(recording: Recording) -> ReplayReport:
    """Run the recorded configuration over the recorded inputs and return how the outputs compare."""
    stages = Stages(recorded_configs(recording))
    stages.warm_up(batch=True)
    known = [i for i, name in enumerate(_NAMES) if name in recording.names or name not in LATER_COLUMNS]
    outputs = [i for i in known if i >= VOLTS]

    def run(recorded: NDArray[np.float64]) -> NDArray[np.float64]:
        rows = np.zeros((len(recorded), LAYOUT.size))
        rows[:, known] = recorded
        stages.run(rows)
        return rows[:, outputs]

    return replay(recording, run, [_NAMES[i] for i in known], [_NAMES[i] for i in outputs])
