"""The guides of ``docs/adding``, and the tutorial, typed by a stranger in an empty folder with a wheel."""

from __future__ import annotations

import os
import re
import shutil
import subprocess
import sys
import tomllib
from collections.abc import Iterator
from pathlib import Path
from textwrap import dedent

import pytest

from tests.examples.conftest import describe
from tests.examples.test_guides import GUIDES

ROOT = Path(__file__).parents[2]
BLOCK = re.compile(r"(?:<!-- file: \S+/(\S+) -->\n)?^( *)```(?: \{ \.)?(\w*)[^\n]*\n(.*?)^ *```$", re.M | re.S)
SAID = {
    "analog_sensor": r"room\.temperature .* degC",
    "bench_file": "safe state reached: run finished",
    "daq": "linedaq:DRIVER: may run.*safe state reached: run finished",
    "effect": "interpolation_error +periodic error",
    "estimator": "phasor:PHASOR: may run.*every estimate and command is the recorded one, bit for bit",
    "i2c_chip": r"room\.temperature .* degC",
    "i2c_dac": "mcp4728 on i2c0 at .*safe state reached: run finished",
    "twin": "1. saturation of position",
}


def blocks(page: str) -> Iterator[tuple[str, str, str]]:
    """Yield file name, language and text of each block that belongs to a step."""
    for name, indent, language, text in BLOCK.findall(page):
        if len(indent) == 4:
            yield name, language, dedent(text)


def put(tables: str, file: Path) -> None:
    """Put each table of ``tables`` in the place of the table of that name, or behind the one before it."""
    text, before = file.read_text(encoding="utf-8"), ""
    for table in re.split(r"^(?=\[)", tables, flags=re.M)[1:]:
        name = table.partition("]")[0] + "]"
        there = re.escape(name if f"\n{name}" in text else before)
        text, n = re.subn(
            rf"^{there}[^\n]*\n[^\[]*(?:\[[^\n]*\]\n[^\[]*)*?(?=^\[|\Z)",
            lambda m, new=name, t=table: t + "\n" if m[0].startswith(new) else m[0] + t + "\n",
            text,
            count=1,
            flags=re.M,
        )
        assert n == 1, name
        before = name
    file.write_text(text, encoding="utf-8")


@pytest.fixture(scope="module")
def wheel(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The files that a wheel installs."""
    site = tmp_path_factory.mktemp("wheel")
    built = tomllib.loads((ROOT / "pyproject.toml").read_text())["tool"]["hatch"]["build"]["targets"]["wheel"]
    without = [ROOT / name for name in built["exclude"]]
    for folder in built["only-include"]:
        shutil.copytree(
            ROOT / folder,
            site / folder,
            ignore=lambda at, names: [n for n in names if n == "__pycache__" or Path(at, n) in without],
        )
    for start in built["sources"]:
        shutil.copytree(site / start, site, dirs_exist_ok=True)
    return site


def stranger(wheel: Path, folder: Path, place: Path) -> dict[str, str]:
    """Her environment, with ``micron``, ``pytest`` and a ``pip`` that has installed the package in ``folder``."""
    start = "import sys; sys.argv[0] = 'micron'; import micron_start; micron_start.main()"
    programs = {"micron": f'-c "{start}"', "python": "", "pytest": "-m pytest", "pip": "-c pass"}
    (place / "bin").mkdir(parents=True)
    for name, does in programs.items():
        (place / "bin" / name).write_text(f'#!/bin/sh\nexec {sys.executable} {does} "$@"\n')
        (place / "bin" / name).chmod(0o755)
    clean = {k: v for k, v in os.environ.items() if not k.startswith(("PYTEST_", "MICRON_"))}
    return clean | {
        "PATH": f"{place / 'bin'}:{os.environ['PATH']}",
        "PYTHONPATH": f"{wheel}:{place / 'installed'}:{folder}",
        "XDG_STATE_HOME": str(place / "state"),
        "COLUMNS": "120",
    }


@pytest.mark.slow
@pytest.mark.timeout(600)
@pytest.mark.parametrize("name", GUIDES)
def test_a_stranger_types_the_guide(name: str, wheel: Path, tmp_path: Path) -> None:
    folder, said = tmp_path / "part", ""
    folder.mkdir()
    environment = stranger(wheel, folder, tmp_path / "hers")
    for file, language, text in blocks(GUIDES[name].read_text(encoding="utf-8")):
        if file:
            (folder / file).write_text(text, encoding="utf-8")
        elif language == "toml":
            put(text, folder / "micron.toml")
        else:
            assert language == "bash"
            if "pip install -e ." in text:
                describe(folder, tmp_path / "hers")
            done = subprocess.run(
                ["bash", "-e", "-c", text], cwd=folder, env=environment, capture_output=True, text=True, check=False
            )
            said += done.stdout + done.stderr
            assert done.returncode == 0, said
    assert re.search(SAID[name], said, flags=re.S), said
    assert " passed" in said


@pytest.mark.slow
@pytest.mark.timeout(600)
def test_a_stranger_types_the_tutorial(wheel: Path, tmp_path: Path) -> None:
    folder, said = tmp_path / "hers", ""
    environment = stranger(wheel, folder, folder)
    for _, _, language, text in BLOCK.findall((ROOT / "docs" / "tutorial-mismatch.md").read_text(encoding="utf-8")):
        if language == "toml":
            described = folder / "out" / "lab-tremor" / "recording.toml"
            head, _, rest = described.read_text(encoding="utf-8").partition("[twin]")
            described.write_text(head + text + rest[rest.index("\n[[channels]]") :], encoding="utf-8")
            continue
        done = subprocess.run(
            ["bash", "-e", "-c", text], cwd=folder, env=environment, capture_output=True, text=True, check=False
        )
        said += done.stdout + done.stderr
        assert done.returncode == 0, said
    assert "rate dependent hysteresis" in said
    assert "safe state reached: run finished" in said
    assert said.count("Residual on data that no fit has seen") == 2


@pytest.mark.slow
def test_a_wheel_says_where_the_commands_of_research_are(wheel: Path, tmp_path: Path) -> None:
    environment = stranger(wheel, tmp_path, tmp_path / "hers")
    for command in ("tremor evaluate hand.csv", "mismatch prove --cases 1"):
        done = subprocess.run(
            ["micron", *command.split()], cwd=tmp_path, env=environment, capture_output=True, text=True, check=False
        )
        assert (done.returncode, done.stdout) == (2, "")
        assert "is a command of the source tree; an installed wheel lacks it" in done.stderr
        assert len(done.stderr.splitlines()) == 1
