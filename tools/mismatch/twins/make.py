"""From the ``[twin]`` table to a twin."""

from __future__ import annotations

from tools.mismatch.recording import Recording, RecordingError
from tools.mismatch.twins.base import Twin
from tools.mismatch.twins.static import static_twin


def make(recording: Recording) -> Twin:
    """The twin of a recording. Unknown kinds and parameters are RecordingErrors."""
    kind = recording.twin.kind
    if kind in ("piezo_stack", "accelerometer", "magnetometer"):
        return static_twin(recording)
    raise RecordingError(f"{recording.path}: [twin] kind '{kind}' is unknown")
