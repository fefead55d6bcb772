"""Runs the recorded samples of an endoscope through the same step and compares view and attitude bit for bit."""

from __future__ import annotations

import json

import numpy as np
from numpy.typing import NDArray
from pydantic import ValidationError

from firmware_py.endoscope.config import EndoscopeConfig
from firmware_py.endoscope.frame import LAYOUT, OUTPUTS
from firmware_py.endoscope.steering import Steering
from firmware_py.recording.errors import RecordingError
from firmware_py.recording.reader import Recording
from firmware_py.recording.replay import ReplayReport, replay


def replay_endoscope(recording: Recording) -> ReplayReport:
    """Replay a recording of an endoscope bench. Raises ``RecordingError`` for one without configuration or inputs."""
    metadata, names = recording.metadata, LAYOUT.scalar_names()
    if "card_status" not in recording.names:
        raise RecordingError(
            f"{recording.path}: this recording of an endoscope has no card_status, fused and held; record the run "
            "again with this version to replay it"
        )
    try:
        config = EndoscopeConfig.model_validate(json.loads(str(metadata["endoscope"])))
        steering = Steering(config, recording.tick_hz)
    except (ValueError, ValidationError) as error:
        raise RecordingError(f"{recording.path}: its configuration cannot be read: {error}") from error

    def run(inputs: NDArray[np.float64]) -> NDArray[np.float64]:
        rows = np.zeros((len(inputs), LAYOUT.size))
        rows[:, :OUTPUTS] = inputs
        for row in rows:
            steering.step(row)
        return rows[:, OUTPUTS:]

    return replay(recording, run, names[:OUTPUTS], names[OUTPUTS:])
