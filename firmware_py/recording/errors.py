"""Defines the errors of a recording and of the recorder."""

from __future__ import annotations

from hal.errors import BenchError


class RecordingError(BenchError):
    """Reports a file that is not a recording, not of this kind, or cannot be written (exit status 2)."""


class RecorderFailed(RecordingError):
    """The recorder process could not start or broke down; the message is the recorder's own."""
