"""A chosen picture that cannot be written is refused before the work; without a choice the work is done without it."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner

from tools.cli.common import place_picture
from tools.cli.main import app
from tools.errors import InputError


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    np.savez(tmp_path / "rest.npz", x=np.random.default_rng(1).normal(size=4000))
    monkeypatch.chdir(tmp_path)
    return tmp_path


@pytest.mark.parametrize("words", ["run --virtual", "simulate", "noise rest.npz --rate-hz 100", "imu rest.npz"])
@pytest.mark.parametrize(
    ("picture", "message"), [("no/x.png", "does not exist; create it first"), ("x.csv", "a picture ends in .png")]
)
def test_a_chosen_picture_is_checked_before_the_work(folder: Path, words: str, picture: str, message: str) -> None:
    done = CliRunner().invoke(app, [*words.split(), "--picture", picture])
    assert done.exit_code == 2, done.output
    assert message in done.stderr
    assert [p.name for p in folder.iterdir()] == ["rest.npz"]


def test_without_a_choice_the_work_is_done_without_a_picture(folder: Path) -> None:
    (folder / "out").write_text("a file where the folder would be")
    done = CliRunner().invoke(app, ["noise", "rest.npz", "--rate-hz", "100", "--json", "noise.json"])
    assert done.exit_code == 0, done.output
    assert done.stderr.count("note: no picture will be written: ") == 1
    assert "picture: " not in done.stderr.replace("no picture", "")
    assert (folder / "noise.json").is_file()


def test_the_folder_of_a_default_picture_is_made_when_it_is_written(folder: Path) -> None:
    assert place_picture(None, Path("out/deep/x.png")) == Path("out/deep/x.png")
    assert not (folder / "out").exists()
    assert place_picture(Path("x.png"), Path("out/x.png")) == Path("x.png")
    with pytest.raises(InputError, match="is read by this command"):
        place_picture(Path("rest.npz"), Path("out/x.png"), reads=["rest.npz"])


def test_a_run_whose_default_picture_has_no_place_goes_on(folder: Path) -> None:
    (folder / "out").write_text("a file where the folder would be")
    done = CliRunner().invoke(app, ["run", "--virtual", "--seconds", "3.5"])
    assert done.exit_code == 0, done.output
    assert done.stderr.count("note: no picture will be written: ") == 1
