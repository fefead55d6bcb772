"""Makes a twin of columns of simulated output that another program computed."""

from __future__ import annotations

from tools.errors import RecordingError
from tools.mismatch.recording import Recording
from tools.mismatch.twins.static import StaticTwin, gain_and_offset

PREFIX = "simulated_"
NAMES = ("offset", "scale")


def columns_twin(recording: Recording) -> StaticTwin:
    """Build a twin whose outputs follow the inputs ``simulated_OUTPUT``. Raises RecordingError.

    The offset (0 by default) and the scale (1) of each column may be re-fitted.
    """
    where = f"{recording.path}: [twin]"
    text = recording.twin.parameters
    for key in text:
        if key not in NAMES:
            raise RecordingError(
                f"{where} parameters: '{key}' is not a parameter of columns; known: {', '.join(NAMES)}"
            )
    drives: dict[str, str] = {}
    for o in recording.outputs:
        column = PREFIX + o
        if column not in recording.inputs:
            raise RecordingError(
                f"{where} columns needs the simulated course of output '{o}': a channel with role = 'input' and"
                f" signal = '{column}'"
            )
        if recording.unit[column] != recording.unit[o]:
            raise RecordingError(
                f"{where} '{column}' is in {recording.unit[column]} and '{o}' in {recording.unit[o]}; give one unit"
            )
        drives[o] = column
    return gain_and_offset(
        recording, NAMES, drives, ("mechanics", "mounting", "environment", "sensor", "acquisition"), (0.0, 1.0)
    )
