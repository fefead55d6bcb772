"""Every command has a worked example in its help, and the example is one that the command accepts."""

from __future__ import annotations

import re
import shlex
from collections.abc import Iterator

import click
import pytest
import typer

from tools.cli.main import app

EXAMPLE = re.compile(r"Examples?:\s*((?:micron .*\n?\s*)+)")


def commands(group: click.Command, path: tuple[str, ...] = ()) -> Iterator[tuple[tuple[str, ...], click.Command]]:
    inner = getattr(group, "commands", None)
    if inner is None:
        yield path, group
        return
    for name, command in sorted(inner.items()):
        yield from commands(command, (*path, name))


ALL = {" ".join(path): (path, command) for path, command in commands(typer.main.get_command(app))}


def refusal(command: click.Command, name: str, given: list[str]) -> str:
    """Conversion and required arguments, without running anything; a file that is not there yet is no refusal."""
    try:
        command.make_context(name, given)
    except click.BadParameter as error:
        return "" if "does not exist" in error.message else error.message
    return ""


@pytest.mark.parametrize("name", ALL)
def test_the_example_parses(name: str):
    path, command = ALL[name]
    found = EXAMPLE.search(command.help or "")
    assert found, f"micron {name} --help has no 'Example: micron {name} ...'"
    for line in found.group(1).strip().splitlines():
        words = shlex.split(line, comments=True)
        assert tuple(words[1 : len(path) + 1]) == path, line
        assert not refusal(command, name, words[len(path) + 1 :]), line


def test_a_bare_call_helps():
    from typer.testing import CliRunner

    result = CliRunner().invoke(app, [])
    assert "micron" in result.output
    assert "run" in result.output
    assert result.exit_code in (0, 2)
