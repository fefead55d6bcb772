"""What can be wrong with a recording."""

from __future__ import annotations

from hal.errors import BenchError


class RecordingError(BenchError):
    """Not a recording, not this kind of recording, or a file that cannot be written (exit status 2)."""


class RecorderFailed(RecordingError):
    """The recorder process could not start or broke down; the message is the recorder's own."""
