"""Bad input from a person or a file, the same in every tool."""

from __future__ import annotations


class InputError(ValueError):
    """The message says what, where and what to do; commands end with exit status 2."""


class OutputError(InputError):
    """A result could not be written after the work was done; commands end with exit status 1."""
