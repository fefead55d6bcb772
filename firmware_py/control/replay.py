"""The same stages over a recording: recorded inputs in, estimates and commands out, compared bit for bit."""

from __future__ import annotations

import json

import numpy as np
from numpy.typing import NDArray

from firmware_py.control.stages import StageConfigs, Stages
from firmware_py.frame import LAYOUT, VOLTS
from firmware_py.recording.errors import RecordingError
from firmware_py.recording.reader import Recording
from firmware_py.recording.replay import ReplayReport, replay

OUTPUT_COLUMNS = LAYOUT.scalar_names()[VOLTS:]
"""What a replay must find again. It is given the rest, commands chosen by hand, and the bits that the loop set."""


def recorded_configs(recording: Recording) -> StageConfigs:
    """The configuration that the run was made with. ``RecordingError`` when the recording has none."""
    text = recording.metadata.get("stages")
    if not isinstance(text, str):
        raise RecordingError(f"{recording.path}: no stage configuration in its metadata; only runs can be replayed")
    return StageConfigs.from_dict(json.loads(text), str(recording.path))


def replay_recording(recording: Recording) -> ReplayReport:
    """Run the recorded configuration over the recorded inputs."""
    stages = Stages(recorded_configs(recording))
    stages.warm_up()

    def run(rows: NDArray[np.float64]) -> NDArray[np.float64]:
        stages.run(rows)
        return rows[:, VOLTS:]

    return replay(recording, run, LAYOUT.scalar_names(), OUTPUT_COLUMNS)
