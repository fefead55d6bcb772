"""Stamps a page with its revision and date."""

from __future__ import annotations

from datetime import UTC, datetime

from firmware_py.recording.revision import git_revision


def revision_and_day() -> str:
    """Return the source's revision and the day (UTC) for the head of a generated page."""
    return f"{git_revision() or 'unknown'}, {datetime.now(UTC):%Y-%m-%d}"
