"""Builds a twin from the ``[twin]`` table, effects included."""

from __future__ import annotations

from tools.mismatch.recording import Recording
from tools.mismatch.twins.base import Twin
from tools.mismatch.twins.core import core


def make(recording: Recording) -> Twin:
    """Build the twin of a recording; effects of a corrected twin are part of its base physics.

    Raises RecordingError for unknown kinds, parameters and effects.
    """
    if recording.twin.effects:
        from tools.mismatch.twins.corrected import corrected_twin

        return corrected_twin(recording)
    return core(recording)
