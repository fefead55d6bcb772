"""From what, and when, a page was made."""

from __future__ import annotations

from datetime import UTC, datetime

from firmware_py.recording.revision import git_revision


def revision_and_day() -> str:
    """The source's revision and the day (UTC), as the head of a page made by a command says them."""
    return f"{git_revision() or 'unknown'}, {datetime.now(UTC):%Y-%m-%d}"
