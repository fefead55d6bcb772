"""Every command has a worked example in its help, and the example is one that the command accepts."""

from __future__ import annotations

import re
import shlex
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import click
import pytest
import typer
from typer.testing import CliRunner

from tools.cli.main import COMMANDS, INSIDE, RESEARCH, Helpful, app
from tools.cli.reference import micron

EXAMPLE = re.compile(r"Examples?:\s*((?:micron .*\n?\s*)+)")


def commands(group: click.Command, path: tuple[str, ...] = ()) -> Iterator[tuple[tuple[str, ...], click.Command]]:
    inner = getattr(group, "commands", None)
    if inner is None:
        yield path, group
        return
    for name, command in sorted(inner.items()):
        yield from commands(command, (*path, name))


ALL = {" ".join(path): (path, command) for path, command in commands(micron)}


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


ROOT = Path(__file__).parents[3]
FENCE = re.compile(r"^ *```[^\n]*\n(.*?)^ *```", re.MULTILINE | re.DOTALL)


def parse(line: str) -> None:
    """Parse a line that begins with ``micron``. Raises for a command or an option that is not there."""
    words = shlex.split(line, comments=True)
    path, command = next(v for v in ALL.values() if tuple(words[1 : len(v[0]) + 1]) == v[0])
    command.make_context(words[0], words[len(path) + 1 :])


def typed(page: Path) -> list[str]:
    """Return the commands in the code blocks of a page."""
    blocks = FENCE.findall(page.read_text(encoding="utf-8"))
    return [line.strip() for block in blocks for line in block.splitlines() if line.strip().startswith("micron ")]


PAGES = [p for p in (ROOT / "README.md", ROOT / "CONTRIBUTING.md", *(ROOT / "docs").rglob("*.md")) if typed(p)]


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.stem)
def test_the_commands_of_a_page_parse(page: Path):
    for line in typed(page):
        parse(line)


def test_a_command_or_option_that_is_gone_does_not_parse():
    assert len(PAGES) > 15
    with pytest.raises(StopIteration):
        parse("micron nosuch")
    with pytest.raises(typer.BadParameter.__bases__[0], match="No such option"):
        parse("micron run --nosuch 1")


GROUPS = [name for name, command in micron.commands.items() if hasattr(command, "commands")]


@pytest.mark.parametrize("words", [[], *([name] for name in GROUPS)], ids=str)
def test_a_bare_call_helps(words: list[str]):
    """On standard output with exit status 0: who asks nothing has made no mistake. What the help names is there."""
    result = CliRunner().invoke(app, words)
    assert result.exit_code == 0
    assert f"Usage: {' '.join(['micron', *words])} " in result.stdout
    assert not result.stderr
    if not words:
        steps = re.findall(r"micron (\w+): ", result.stdout)
        assert steps == ["doctor", "run", "bench"]
        assert set(steps) <= set(COMMANDS)


@pytest.mark.parametrize("words", [["nosuch"], ["data", "nosuch"]], ids=str)
def test_a_command_that_is_not_there_is_bad_input(words: list[str]):
    result = CliRunner().invoke(app, words)
    assert result.exit_code == 2
    assert "No such command 'nosuch'" in result.stderr


@pytest.mark.parametrize("name", COMMANDS)
def test_the_list_says_what_the_help_says(name: str):
    own = micron.commands[name].help or ""
    assert COMMANDS[name].line == " ".join(own.split("\n\n")[0].split())


WRITTEN = (
    "--bench-out", "--cache", "--html", "--json", "--keep", "--out", "--picture", "--png", "--record", "--recordings",
    "--report", "--rows", "--series",
)  # fmt: skip
READ = {("mismatch plan", "--report")}
"""Options that are written elsewhere and read here."""
OUTPUTS = [
    (name, flag)
    for name, (_, command) in ALL.items()
    for p in command.params
    for flag in p.opts
    if flag in WRITTEN and (name, flag) not in READ
]


@pytest.mark.parametrize(("name", "flag"), OUTPUTS)
def test_an_output_that_looks_like_an_option_is_refused(
    name: str, flag: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """``--out --help`` wrote a file of that name."""
    monkeypatch.chdir(tmp_path)
    path, command = ALL[name]
    words = [flag, "--help"]
    for needed in (p.opts[0] for p in command.params if p.required and flag not in p.opts):
        words += [needed, "x.toml"] if needed.startswith("-") else ["x.toml"]
    result = CliRunner().invoke(app, [*path, *words])
    assert result.exit_code == 2, result.output
    assert "looks like an option" in result.stderr
    assert not list(tmp_path.iterdir())


def test_the_wheel_has_about_twenty_commands_in_panels():
    of_panel: dict[str, list[str]] = {}
    for name, command in COMMANDS.items():
        of_panel.setdefault(command.panel, []).append(name)
    assert list(of_panel) == ["Run", "Look", "Calibrate", "Mismatch", "Research"]
    assert len(COMMANDS) - len(of_panel["Research"]) <= 23
    shown = CliRunner().invoke(app, ["--help"]).stdout
    places = [shown.index(f"─ {panel} ─") for panel in of_panel]
    assert places == sorted(places)


VERBS = (
    "Break", "Check", "Compute", "Download", "Draw", "Find", "Fit", "Identify", "Inspect", "Keep", "Learn", "Let",
    "List", "Locate", "Make", "Measure", "Print", "Record", "Run", "Say", "Score", "Serve", "Show",
    "Simulate", "Step", "Take", "Train", "Write",
)  # fmt: skip


@pytest.mark.parametrize("name", [*ALL, *GROUPS])
def test_the_help_begins_with_what_the_command_does(name: str):
    command = ALL[name][1] if name in ALL else micron.commands[name]
    assert (command.help or "").split()[0] in VERBS


@pytest.mark.parametrize("name", GROUPS)
def test_no_group_of_one(name: str):
    assert len(getattr(micron.commands[name], "commands", {})) > 1


def test_the_readme_names_every_command():
    readme = (Path(__file__).parents[3] / "README.md").read_text(encoding="utf-8")
    table = readme[readme.index("## The commands") :]
    assert not [name for name in COMMANDS if not re.search(rf"`(micron )?{name}\b", table)]


def test_commands_that_need_no_kernels_start_without_them():
    """Seconds on every call: ``--help``, ``doctor``, and what ``scan`` needs in its own process."""
    script = """
import sys
from contextlib import suppress
from tools.cli.main import app
for words in ([], ["--help"], ["run", "--help"], ["doctor", "--json", "-"]):
    with suppress(SystemExit):
        app(words)
import sim_devices.process_world, sim_devices.register, tools.diagnose.scan
assert not {"numba", "scipy", "matplotlib"} & set(sys.modules), sorted(sys.modules)
"""
    done = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr[-300:]


def test_the_commands_that_a_wheel_lacks_are_those_of_research():
    inside = {f"{group} {name}" for group, names in INSIDE.items() for name in names}
    assert set(RESEARCH) == {name for name, command in COMMANDS.items() if command.panel == "Research"} | inside


@pytest.mark.parametrize("name", ["tremor", "mismatch prove"])
def test_a_command_that_a_wheel_lacks_is_one_message(name: str, capsys: pytest.CaptureFixture[str]):
    *group, command = name.split()
    context = click.Context(Helpful(name="micron"), info_name=" ".join(["micron", *group]))
    with pytest.raises(click.exceptions.Exit) as end:
        Helpful(name="micron").resolve_command(context, [command, "--json", "x.json"])
    assert end.value.exit_code == 2
    assert capsys.readouterr().err == f"micron: '{name}' is a command of the source tree; an installed wheel lacks it\n"
