"""`--watch` of `micron run` and `micron bench`: bad input is one message with exit status 2, before anything runs."""

from __future__ import annotations

from pathlib import Path

import pytest
from typer.testing import CliRunner

from tests.conftest import DEFAULT_BENCH
from tools.cli.main import app


def run(*words: object):
    return CliRunner().invoke(app, [str(w) for w in words])


@pytest.fixture
def twin(tmp_path: Path) -> Path:
    (tmp_path / "bench.toml").write_text(DEFAULT_BENCH.read_text())
    (tmp_path / "twin.toml").write_text('[twin]\nkind = "instrument"\n[twin.parameters]\nbench = "bench.toml"\n')
    return tmp_path / "twin.toml"


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (["--watch-reference", 20], "--watch-reference belongs to --watch"),
        (["--false-alarms-per-hour", 1], "--false-alarms-per-hour belongs to --watch"),
        (["--watch", "TWIN"], "the first 300 s are the reference of --watch"),
        (["--watch", "TWIN", "--seconds", 30, "--watch-reference", 5], "must be 15 to 3600 s"),
        (["--watch", "TWIN", "--seconds", 390, "--false-alarms-per-hour", 0], "must be 1e-06 to 60"),
        (["--watch", "none.toml", "--seconds", 390], "none.toml"),
        (["--watch", "TWIN", "--seconds", 390, "--bench", "endoscope"], "--watch belongs to the instrument"),
    ],
)
def test_bad_input_of_run(twin: Path, words: list[object], said: str):
    result = run("run", "--virtual", *(twin if w == "TWIN" else w for w in words))
    assert result.exit_code == 2, result.output
    assert said in " ".join(result.output.split())


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (["--watch-reference", 20], "--watch-reference belongs to --watch"),
        (["--watch", "none.toml"], "none.toml"),
        (["--watch", "TWIN", "--watch-reference", 1], "must be 15 to 3600 s"),
    ],
)
def test_bad_input_of_the_page(twin: Path, words: list[object], said: str):
    result = run("bench", "--port", 0, *(twin if w == "TWIN" else w for w in words))
    assert result.exit_code == 2, result.output
    assert said in " ".join(result.output.split())
