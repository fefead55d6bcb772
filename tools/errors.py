"""Bad input from a person or a file, the same in every tool."""

from __future__ import annotations

import errno
from collections.abc import Iterable, Sequence
from difflib import get_close_matches
from pathlib import Path

FULL = (errno.ENOSPC, errno.EDQUOT)
"""Error numbers of a disk, or of one's share of it, that is full."""


class InputError(ValueError):
    """The message says what, where and what to do; commands end with exit status 2."""


class OutputError(InputError):
    """A result could not be written after the work was done; commands end with exit status 1."""


class RecordingError(InputError):
    """A recording, or its description, cannot be used. The message names file, key, line or sample, and what to do."""


def refuse_unknown_keys(where: str, keys: Iterable[str], known: Iterable[str], what: str = "key") -> None:
    """Raise ``RecordingError`` for the first of ``keys`` that is not ``known``; it names the most similar known key.

    ``what`` is the word for a key in the message.
    """
    allowed = list(known)
    for key in keys:
        if key in allowed:
            continue
        similar = get_close_matches(key, allowed, 1)
        advice = f"; write '{similar[0]}', or leave it out" if similar else "; leave it out"
        raise RecordingError(f"{where} {what} '{key}' is unknown{advice}. Known {what}s: {', '.join(allowed)}")


def missing_column(path: Path, name: str, have: Sequence[str]) -> RecordingError:
    """Return the error for a column that a file does not have."""
    text = ", ".join(have[:12]) + (" ..." if len(have) > 12 else "")
    return RecordingError(f"{path}: no column '{name}'; the file has: {text or 'none'}")
