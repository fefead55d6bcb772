"""The same stages over a recording: recorded inputs in, estimates and commands out, compared bit for bit."""

from __future__ import annotations

import json

import numpy as np
from numpy.typing import NDArray

from firmware_py.control.stages import StageConfigs, Stages
from firmware_py.frame import COMMAND, LAYOUT, STATUS, VOLTS, FrameStatus
from firmware_py.recording.errors import RecordingError
from firmware_py.recording.reader import Recording
from firmware_py.recording.replay import ReplayReport, replay

_NAMES = LAYOUT.scalar_names()
INPUT_COLUMNS = (*_NAMES[:VOLTS], *_NAMES[COMMAND : COMMAND + 3], "status")
"""What a replay is given: everything left of the volts, commands chosen by hand, and the bits that the loop set."""
OUTPUT_COLUMNS = _NAMES[VOLTS:]
"""What it must find again."""
_GIVEN_BITS = int(FrameStatus.GAP | FrameStatus.STALE)


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
    frame = stages.frame
    outputs = frame[VOLTS:]

    def step(inputs: NDArray[np.float64]) -> NDArray[np.float64]:
        status = int(inputs[-1])
        frame[:VOLTS] = inputs[:VOLTS]
        frame[STATUS] = status & _GIVEN_BITS
        stages.sense()
        stages.estimate()
        if status & FrameStatus.COMMANDED:
            stages.actuate()
        elif status & FrameStatus.MANUAL:
            frame[COMMAND : COMMAND + 3] = inputs[VOLTS:-1]
            stages.follow()
        return outputs

    return replay(recording, step, INPUT_COLUMNS, OUTPUT_COLUMNS)
