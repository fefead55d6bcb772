"""``micron doctor`` finds what would stop the firmware, and the guide's first hour passes it."""

from __future__ import annotations

import json
import re
import shutil
import subprocess
from pathlib import Path

import pytest

from tests.command import micron

ROOT = Path(__file__).parents[3]


@pytest.fixture
def place(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    shutil.copytree(ROOT / "benches", tmp_path / "benches")
    monkeypatch.chdir(tmp_path)
    return tmp_path


@pytest.mark.slow
def test_a_bench_file_made_as_the_guide_says_is_whole(place: Path):
    guide = (ROOT / "docs" / "lab-machine.md").read_text(encoding="utf-8")
    (made,) = re.findall(r"^mkdir lab && .*$", guide, re.MULTILINE)
    subprocess.run(made, shell=True, check=True, cwd=place)
    for words in (["doctor"], ["run", "--virtual", "--seconds", "0.5", "--picture", "lab/run.png"]):
        done = micron(*words, "--bench", "lab/micron.toml")
        assert done.exit_code == 0, done.output


def test_calibration_that_is_not_there_is_missing_before_a_run_says_so(place: Path):
    shutil.copy("benches/micron.toml", "alone.toml")
    done = micron("doctor", "--bench", "alone.toml", "--json", "-")
    assert done.exit_code == 4
    assert done.stdout.count('"missing"') == 4  # three files, and how many
    assert "copy it beside the bench file" in done.stdout


def test_no_word_of_a_remedy_is_broken_on_a_terminal_of_80_columns(place: Path, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setenv("COLUMNS", "80")
    shutil.copy("benches/micron.toml", "alone.toml")
    done = micron("doctor", "--bench", "alone.toml", "--json", "found.json")
    assert all(len(line.rstrip()) <= 80 for line in done.output.splitlines())
    words = {w for f in json.loads(Path("found.json").read_text())["findings"] for w in f["remedy"].split()}
    assert words <= set(done.output.split())


def test_a_bench_that_ships_is_known_by_its_name_and_another_name_is_refused() -> None:
    assert micron("doctor", "--bench", "micron-can").exit_code in (0, 1)  # 1: of the machine
    done = micron("doctor", "--bench", "nowhere")
    assert done.exit_code == 2
    assert "nowhere: no such bench file, and none of that name ships; these do: endoscope" in done.output
