"""Runs the command line in the process of a test."""

from __future__ import annotations

from typing import Any

from typer.testing import CliRunner, Result

from tools.cli.main import app


def micron(*words: object, **options: Any) -> Result:
    """Run ``micron`` with ``words``, each as text; ``options`` as for ``CliRunner.invoke``."""
    return CliRunner().invoke(app, [str(word) for word in words], **options)
