"""The whole command as one click object: what the documentation's page of commands is made from."""

from __future__ import annotations

import typer

from tools.cli.main import app

micron = typer.main.get_command(app)
