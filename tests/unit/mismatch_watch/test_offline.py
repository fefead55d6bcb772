"""``micron mismatch watch``: says when and where, or that nothing happens; bad input is one message."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner

from tests.unit.mismatch_report.systems import recording
from tools.cli.main import app

TWIN = '[twin]\nkind = "piezo_stack"\n[twin.parameters]\ngain_um_per_V = 0.125\noffset_um = -1.0\n'


def good(u: np.ndarray, _: np.ndarray) -> np.ndarray:
    return 0.125 * u - 1.0


def jumps(u: np.ndarray, t: np.ndarray) -> np.ndarray:
    return good(u, t) + np.where(t > 90.0, 0.02, 0.0)


def run(*words: object):
    return CliRunner().invoke(app, ["mismatch", "watch", *map(str, words)])


@pytest.fixture
def twin(tmp_path: Path) -> Path:
    (tmp_path / "twin.toml").write_text(f"format = 1\n{TWIN}")
    return tmp_path / "twin.toml"


def test_a_jump_is_dated_and_placed(tmp_path: Path, twin: Path):
    folder = recording(tmp_path / "r", change=jumps, samples=12_000).parent
    result = run(twin, folder, "--reference", 60, "--json", "-")
    assert result.exit_code == 0, result.output
    body = json.loads(result.stdout)
    assert body["verdict"] == "leaves"
    (found,) = body["departures"]
    assert (found["channel"], found["figure"], found["rises"], found["unit"]) == ("displacement", "level", True, "um")
    assert found["onset_s"] == pytest.approx(90.0, abs=1.0)
    assert 90.0 < found["alarm_s"] < 95.0
    assert "Reality leaves the twin at about 9" in result.stderr


def test_a_good_twin_stays(tmp_path: Path, twin: Path):
    folder = recording(tmp_path / "r", change=good, samples=12_000).parent
    result = run(twin, folder)
    assert result.exit_code == 0, result.output
    assert "Reality does not leave the twin." in result.stdout
    assert "at most 0.01 false alarms per hour in one channel." in " ".join(result.stdout.split())


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (["--reference", "500"], "lasts 20 s"),
        (["--reference", "5"], "at least 100 are needed"),
        (["--reference", "0.05"], "the reference gives 0 blocks of"),
        (["--reference", "1e-9"], "the reference gives 0 blocks of"),
        (["--false-alarms-per-hour", "0"], "must be 1e-06 to 60"),
        (["--json", "/no/such/folder/x.json"], "does not exist"),
    ],
)
def test_bad_input_is_one_message(tmp_path: Path, twin: Path, words: list[str], said: str):
    folder = recording(tmp_path / "r", change=good, samples=2000).parent
    result = run(twin, folder, *words)
    assert result.exit_code == 2
    assert said in " ".join(result.output.split())


def test_a_file_that_is_no_twin(tmp_path: Path):
    folder = recording(tmp_path / "r", change=good, samples=2000).parent
    result = run(tmp_path / "none.toml", folder)
    assert result.exit_code == 2
    assert "no such twin" in " ".join(result.output.split())
