"""Brackets reach the reader: rich takes ``[running]`` or ``[ni]`` for a style and leaves it out.

Every message that our code can raise is rebuilt from its source and printed by the console that prints it.
"""

from __future__ import annotations

import ast
import io
import re
from collections.abc import Iterator
from importlib import import_module
from pathlib import Path

import click
import pytest
import typer
from rich.console import Console
from rich.live import Live
from rich.progress import Progress
from rich.table import Table
from rich.text import Text

from hal.errors import BenchError
from tools.cli import common
from tools.cli.common import clear_errors, console, data_console, print_error, print_note, print_whole
from tools.cli.main import COMMANDS, load
from tools.terminal import plain_console, task_name

ROOT = Path(__file__).parents[3]
FOLDERS = ("hal", "drivers", "sim_devices", "firmware_py", "tools", "benches")
SOURCES = sorted(path for folder in FOLDERS for path in (ROOT / folder).rglob("*.py"))
NASTY = "[firmware] [running] [ni] [/] [bold]x[/bold] [link=a]b[/link] \\[a] :warning: [device.daq.bus] [[x]] [red"


def text_of(node: ast.expr) -> str | None:
    """The text of a literal or an f-string, fields as ``[field]``: what they hold may have brackets as well."""
    match node:
        case ast.Constant(value=str()):
            return node.value
        case ast.JoinedStr():
            return "".join(p.value if isinstance(p, ast.Constant) else "[field]" for p in node.values)  # type: ignore[misc]
        case ast.BinOp(op=ast.Add()):
            left, right = text_of(node.left), text_of(node.right)
            return None if left is None or right is None else left + right
    return None


def messages() -> Iterator[tuple[str, str]]:
    """Where, and the text, of every message that is raised or returned by a helper that makes an error."""
    for path in SOURCES:
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            call = node.exc if isinstance(node, ast.Raise) else node.value if isinstance(node, ast.Return) else None
            if not isinstance(call, ast.Call):
                continue
            for argument in call.args:
                text = text_of(argument)
                if text is not None and " " in text:
                    yield f"{path.relative_to(ROOT)}:{node.lineno}", text


def printed(capsys: pytest.CaptureFixture[str]) -> str:
    return capsys.readouterr().err


def test_every_message_reaches_the_reader(capsys: pytest.CaptureFixture[str]) -> None:
    found = list(messages())
    assert len(found) > 400
    assert sum("[" in text.replace("[field]", "") for _, text in found) > 15  # the brackets that the code itself writes
    lost: list[str] = []
    for where, text in found:
        with pytest.raises(typer.Exit), clear_errors():
            raise BenchError(text)
        if printed(capsys) != f"micron: {text}\n":
            lost.append(f"{where}: {text}")
    assert lost == []


def test_brackets_in_everything_that_is_printed(capsys: pytest.CaptureFixture[str]) -> None:
    print_error(NASTY)
    print_note(NASTY)
    console().print(NASTY, soft_wrap=True)
    assert printed(capsys) == f"micron: {NASTY}\nnote: {NASTY}\n{NASTY}\n"
    table = Table(title=NASTY, caption=NASTY)
    table.add_column(NASTY, no_wrap=True)
    table.add_row(NASTY)
    print_whole(table)
    data_console().print(NASTY, soft_wrap=True)
    assert capsys.readouterr().out.count(NASTY) == 5


def test_brackets_in_what_is_shown_meanwhile() -> None:
    """The title of a status table names the state in brackets: ``[running]``."""
    out = io.StringIO()
    shown = plain_console(file=out, width=200, force_terminal=True, color_system=None)
    table = Table("a column" * 8, title="micron run  1.0 of 10 s  [running]")
    with Live(table, console=shown, auto_refresh=False) as live:
        live.refresh()
    assert "[running]" in out.getvalue()
    with Progress(task_name(), console=shown, auto_refresh=False) as progress:
        progress.add_task("[daq0] lost [ni]")
        progress.refresh()
    assert "[daq0] lost [ni]" in out.getvalue()


def test_brackets_beside_a_spinner() -> None:
    out = io.StringIO()
    shown = plain_console(file=out, width=200, force_terminal=True, color_system=None)
    with shown.status("first [ni]", refresh_per_second=0.01) as status:
        status._live.refresh()
        status.update("then [daq0]")
        status._live.refresh()
    assert "first [ni]" in out.getvalue()
    assert "then [daq0]" in out.getvalue()


def test_styles_are_given_by_objects_and_consoles_made_in_one_place() -> None:
    """Who writes markup into a text would see it printed."""
    wrong = [
        f"{path.relative_to(ROOT)}:{number}: {line.strip()}"
        for path in SOURCES
        if path not in (ROOT / "tools" / "terminal.py", ROOT / "tools" / "cli" / "main.py")
        for number, line in enumerate(path.read_text(encoding="utf-8").splitlines(), 1)
        if re.search(r"\[/\]|\[/?(bold|dim|red|green|yellow|cyan)\b[^\]]*\]|rich\.markup|from_markup|\bConsole\(", line)
    ]
    assert wrong == []


READS_MARKUP = {"Spinner", "Panel", "TextColumn", "Status", "track", "SpinnerColumn", "Prompt", "Confirm"}
"""What of rich reads markup whatever the console was told."""


def read_as_markup(source: str) -> Iterator[tuple[int, str]]:
    """Line and text of every argument of those that is neither a constant without brackets nor a ``Text``."""
    for node in ast.walk(ast.parse(source)):
        if not isinstance(node, ast.Call):
            continue
        name = node.func.id if isinstance(node.func, ast.Name) else getattr(node.func, "attr", "")
        if name not in READS_MARKUP:
            continue
        places = {"Panel": (), "track": ()}.get(name, node.args)
        named = [k.value for k in node.keywords if k.arg in ("text", "title", "subtitle", "description", "status")]
        for argument in (*places, *named):
            is_constant = isinstance(argument, ast.Constant) and "[" not in str(argument.value)
            if not is_constant and not ast.unparse(argument).startswith("Text("):
                yield node.lineno, ast.unparse(argument)


def test_no_text_from_outside_is_read_as_markup_behind_the_consoles_back() -> None:
    wrong = [
        f"{path.relative_to(ROOT)}:{line}: {text}"
        for path in SOURCES
        if path.parts[-3:-1] != ("tools", "reproduce") and "rich" in (source := path.read_text(encoding="utf-8"))
        for line, text in read_as_markup(source)
    ]
    assert wrong == []
    assert list(read_as_markup("Spinner('dots', name)\nPanel(x, title=f'{y}')")) == [(1, "name"), (2, "f'{y}'")]
    assert list(read_as_markup("Spinner('dots', 'go')\nPanel(x, title=Text(y))")) == []


def test_nobody_escapes_by_hand() -> None:
    """With plain consoles a backslash before a bracket would be printed (``micron noise`` did)."""
    wrong = [
        f"{path.relative_to(ROOT)}:{number}"
        for path in SOURCES
        if path.is_relative_to(ROOT / "tools")
        for number, line in enumerate(path.read_text(encoding="utf-8").splitlines(), 1)
        if re.search(r"""replace\(["']\[["'],""", line)
    ]
    assert wrong == []


def commands(command: click.Command, name: str) -> Iterator[tuple[str, click.Command]]:
    yield name, command
    for more, inner in getattr(command, "commands", {}).items():
        yield from commands(inner, f"{name} {more}")


@pytest.mark.parametrize("name", sorted(COMMANDS))
def test_brackets_in_the_help(name: str, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    monkeypatch.setenv("COLUMNS", "400")
    monkeypatch.setenv("TERMINAL_WIDTH", "400")
    for path, command in commands(load(name), name):
        texts = [command.help or "", *(getattr(parameter, "help", None) or "" for parameter in command.params)]
        brackets = [found for text in texts for found in re.findall(r"\[[^\[\]]*\]", text)]
        if brackets:
            command.get_help(click.Context(command, info_name=path))
            shown = capsys.readouterr().out
            assert [found for found in brackets if found not in shown] == [], path


def test_the_old_console_would_fail(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    """The check of the check: with rich's own defaults the state disappears."""
    monkeypatch.setattr(common, "plain_console", lambda **options: Console(**options))
    console().print("state [running]", soft_wrap=True)
    assert printed(capsys) == "state \n"
    assert Text("state [running]").plain == "state [running]"
    assert import_module("rich.markup").escape("[a]") == "\\[a]"
