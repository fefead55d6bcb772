"""No result takes the place of a recording, of its data, of another input, or of another result."""

from __future__ import annotations

import shutil
from pathlib import Path

import pytest

from tests.command import micron
from tests.unit.mismatch_report.systems import recording
from tools.errors import InputError
from tools.output import check_folder, check_writable, files_read


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    recording(tmp_path / "rec", change=lambda u, t: 0.1 * u, samples=300)
    (tmp_path / "run.mcap").write_bytes(b"a run")
    (tmp_path / "report.toml").write_text("{}")
    (tmp_path / "twin.toml").write_text('format = 1\n[twin]\nkind = "piezo_stack"\n')
    monkeypatch.chdir(tmp_path)
    return tmp_path


REFUSED = {
    "simulated columns onto the data": "mismatch simulate twin.toml rec --out rec/data.npz",
    "simulated columns onto the descriptor": "mismatch simulate twin.toml rec --out rec/recording.toml",
    "simulated columns onto the twin": "mismatch simulate twin.toml rec --out twin.toml",
    "figures onto the data": "mismatch simulate rec --json rec/data.npz",
    "two results in one file": "mismatch simulate rec --out x.csv --json x.csv",
    "a twin onto the descriptor": "mismatch apply rec report.toml --out rec/recording.toml",
    "a twin onto the report": "mismatch apply rec report.toml --out report.toml",
    "a report onto the data": "mismatch diagnose rec --html rec/data.npz",
    "a watch onto its twin": "mismatch watch twin.toml rec --json twin.toml",
    "a prospect onto the descriptor": "mismatch plan rec --json rec/recording.toml",
    "a guess onto the data": "mismatch new rec/data.npz --force --json rec/data.npz",
    "a cut onto another recording": "mismatch cut rec --out other",
    "a noise model onto the data": "noise rec --json rec/data.npz",
    "a replay onto the recording": "replay run.mcap --json run.mcap",
    "an export onto the recording": "export run.mcap run.mcap --overwrite",
    "an export's figures onto the recording": "export run.mcap out.csv --json run.mcap",
    "a recovery onto the recording": "recover run.mcap --json run.mcap",
    "a run onto the data of another recording": "run --virtual --json rec/data.npz",
    "a run onto another run": "run --virtual --html run.mcap",
    "a calibration onto the log": "calibrate magnetometer rec/data.npz --out rec/data.npz",
}


@pytest.mark.parametrize("case", list(REFUSED))
def test_a_result_that_would_replace_data_is_refused_before_the_work(folder: Path, case: str) -> None:
    shutil.copytree("rec", "other")
    before = {p: p.read_bytes() for p in folder.rglob("*") if p.is_file()}
    done = micron(*REFUSED[case].split())
    assert done.exit_code == 2, done.output
    assert "; name a" in done.stderr
    assert done.stderr.count("\n") == 1
    assert {p: p.read_bytes() for p in folder.rglob("*") if p.is_file()} == before


def test_a_plan_does_not_replace_the_data_that_an_earlier_one_became(folder: Path) -> None:
    text = folder / "rec" / "recording.toml"
    text.write_text(text.read_text().replace("data.npz", "input.npz"))
    shutil.move("rec/data.npz", "rec/input.npz")
    with pytest.raises(InputError, match=r"input\.npz: is read by this command"):
        check_folder(Path("rec"), files=("input.csv", "input.npz"), reads=["rec"])


def test_ordinary_results_in_the_folder_of_a_recording_may_be_written_again(folder: Path) -> None:
    (folder / "rec" / "report.json").write_text("{}")
    check_writable("rec/report.json", "rec/simulated.csv", reads=["rec", "twin.toml", "micron", None])


def test_the_files_of_an_input_are_found_by_what_descriptions_name(folder: Path) -> None:
    text = folder / "rec" / "recording.toml"
    text.write_text(text.read_text() + f'\nfunction = "../f.py:g"\nnote = "{"long " * 200}"\nempty = ""\n')
    (folder / "f.py").write_text("")
    found = {folder / "rec" / "recording.toml", folder / "rec" / "data.npz", folder / "f.py"}
    assert files_read(Path("rec")) == found
    assert files_read(Path()) == found | {folder / "report.toml", folder / "twin.toml"}
    assert files_read(Path("nowhere")) == set()


def test_force_of_new_replaces_a_descriptor(folder: Path) -> None:
    arguments = ["mismatch", "new", "rec/data.npz", "--rate", "1000"]
    assert micron(*arguments).exit_code == 2
    done = micron(*arguments, "--force")
    assert done.exit_code == 0, done.output
