"""What docs/adding promises of the examples: all of their code is shown, and how much it is."""

from __future__ import annotations

import re
import runpy
import tomllib
from pathlib import Path

import pytest

HERE = Path(__file__).parent
DOCS = HERE.parents[1] / "docs" / "adding"
GUIDES = {folder.name: DOCS / f"{folder.name.replace('_', '-')}.md" for folder in HERE.iterdir() if folder.is_dir()}
GUIDES.pop("__pycache__", None)
PAGES = sorted(DOCS.parent.rglob("*.md"))
with_code = runpy.run_path(str(HERE.parents[1] / ".ci" / "show_code.py"))["with_code"]


@pytest.mark.parametrize("name", GUIDES)
def test_the_guide_shows_every_file(name: str):
    shown = re.findall(rf"<!-- file: tests/examples/{name}/(.+) -->", GUIDES[name].read_text(encoding="utf-8"))
    assert sorted(shown) == sorted(p.name for p in (HERE / name).iterdir() if p.is_file())


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.stem)
def test_the_code_of_a_page_is_that_of_the_file(page: Path):
    """The page holds the code itself, so that a plain git host shows it, too."""
    text = page.read_text(encoding="utf-8")
    assert with_code(text) == text, "python .ci/show_code.py"
    assert "--8<--" not in text


@pytest.mark.parametrize("name", GUIDES)
def test_it_takes_fewer_than_120_lines_of_code_tests_included(name: str):
    most = 190 if name == "i2c_dac" else 120
    assert sum(len(p.read_text(encoding="utf-8").splitlines()) for p in (HERE / name).glob("*.py")) < most


@pytest.mark.parametrize("name", GUIDES)
def test_the_guide_says_how_many_lines_each_file_has(name: str):
    stated = re.search(r"It has (\d+ lines[^.]+)\.", GUIDES[name].read_text(encoding="utf-8"))
    assert stated is not None
    counts = [len(p.read_text(encoding="utf-8").splitlines()) for p in (HERE / name).glob("*.py")]
    assert {str(n) for n in counts} <= set(re.findall(r"\d+", stated.group(1)))


@pytest.mark.parametrize("file", sorted(HERE.glob("*/pyproject.toml")), ids=lambda file: file.parent.name)
def test_all_of_its_modules_are_installed(file: Path):
    """Without the list, setuptools refuses a folder that holds more than one module, tests included."""
    listed = tomllib.loads(file.read_text(encoding="utf-8"))["tool"]["setuptools"]["py-modules"]
    assert sorted(listed) == sorted(p.stem for p in file.parent.glob("*.py") if not p.stem.startswith("test_"))
