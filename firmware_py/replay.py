"""Replays a recording with the instrument that made it, and compares every output bit for bit."""

from __future__ import annotations

from firmware_py.layouts import layout_of_recording
from firmware_py.recording.reader import Recording
from firmware_py.recording.replay import ReplayReport


def replay_recording(recording: Recording) -> ReplayReport:
    """Run the recorded configuration over the recorded inputs and return how the outputs compare. Raises
    ``RecordingError`` for a recording that is not of a run."""
    if layout_of_recording(recording.metadata).instrument == "endoscope":
        from firmware_py.endoscope.replay import replay_endoscope

        return replay_endoscope(recording)
    from firmware_py.control.replay import replay_micron

    return replay_micron(recording)
