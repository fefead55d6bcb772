"""Consoles that print what they are given: brackets in a message are text, never markup.

Rich reads ``[running]`` or ``[firmware]`` as a style and leaves it out. Style is given by ``rich.text.Text`` or
``style=`` instead, so that no message has to be escaped.
"""

from __future__ import annotations

from typing import Any

from rich.console import Console
from rich.progress import TextColumn


def plain_console(**options: Any) -> Console:
    """A console without markup, emoji codes and highlighting; ``options`` as for ``rich.console.Console``."""
    return Console(markup=False, emoji=False, highlight=False, **options)


def task_name() -> TextColumn:
    """The column of a progress display that names the task, as plain text."""
    return TextColumn("{task.description}", markup=False)
