"""Bad input from a person or a file, the same in every tool."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path


class InputError(ValueError):
    """The message says what, where and what to do; commands end with exit status 2."""


class OutputError(InputError):
    """A result could not be written after the work was done; commands end with exit status 1."""


class RecordingError(InputError):
    """A recording, or its description, cannot be used. The message names file, key, line or sample, and what to do."""


def missing_column(path: Path, name: str, have: Sequence[str]) -> RecordingError:
    """Return the error for a column that a file does not have."""
    text = ", ".join(have[:12]) + (" ..." if len(have) > 12 else "")
    return RecordingError(f"{path}: no column '{name}'; the file has: {text or 'none'}")
