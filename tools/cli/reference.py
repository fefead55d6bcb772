"""Builds the whole command as one click object, from which the page of commands and the tests are made."""

from __future__ import annotations

import typer

from tools.cli.main import COMMANDS, app, load

micron = typer.main.get_group(app)
micron.commands.update({name: load(name) for name in COMMANDS})
