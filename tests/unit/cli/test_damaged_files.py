"""Files that are damaged, of another kind, out of reach or changed by hand are refused in one line."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import typer

from tests.command import micron
from tests.unit.mismatch_report.canned import missing_physics
from tests.unit.mismatch_report.systems import recording
from tools.cli.common import Exit, clear_errors


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    recording(tmp_path / "rec", change=lambda u, t: 0.125 * u - 1.0, samples=300)
    monkeypatch.chdir(tmp_path)
    return tmp_path


def refused(words: str, folder: Path) -> str:
    before = sorted(folder.rglob("*"))
    done = micron(*words.split())
    assert done.exit_code == Exit.BAD_INPUT, (done.output, done.exception)
    assert sorted(folder.rglob("*")) == before
    return done.stderr.splitlines()[-1]


def figures(name: str, value: object) -> Callable[[dict], None]:
    return lambda report: report["fit"].update({name: value})


CHANGED: dict[str, tuple[Callable[[dict], None], str]] = {
    "no units": (figures("unit", None), "the report's outputs"),
    "units are a number": (figures("unit", -1.0), "the report's outputs"),
    "parameters are a text": (figures("base_parameters", "x"), "changed by hand"),
    "a parameter has no figure": (figures("base_parameters", [{"name": "gain"}]), "changed by hand"),
    "a parameter is no number": (figures("base_parameters", [{"name": "gain", "with_effects": []}]), "changed by hand"),
    "corrected parameters are texts": (lambda r: r.update(corrected_parameters=["x"]), "changed by hand"),
    "corrected parameters are a number": (lambda r: r.update(corrected_parameters=1.0), "changed by hand"),
    "a setting is not finite": (lambda r: r["physics"][0]["settings"].update(a=[float("nan")]), "finite numbers"),
    "no fastest rate": (lambda r: r["physics"][0]["settings"].update(fastest_per_s=[]), "fastest_per_s"),
    "a negative fastest rate": (lambda r: r["physics"][0]["settings"].update(fastest_per_s=[-1]), "fastest_per_s"),
}


@pytest.mark.parametrize("case", list(CHANGED))
def test_a_report_that_was_changed_by_hand_is_refused(folder: Path, case: str) -> None:
    change, message = CHANGED[case]
    report = missing_physics().to_json()
    change(report)
    (folder / "report.json").write_text(json.dumps(report))
    assert message in refused("mismatch apply rec report.json --out twin.toml", folder)


def test_an_integer_that_no_float_holds_is_refused(folder: Path) -> None:
    text = folder / "rec" / "recording.toml"
    text.write_text(text.read_text().replace("[twin]", "[conditions]\nload = 1" + 400 * "0" + "\n[twin]", 1))
    assert "[conditions] load must be a number" in refused("mismatch simulate rec", folder)


def test_a_data_file_in_place_of_a_recording_is_told_how_to_become_one(folder: Path) -> None:
    assert "'micron mismatch new rec/data.npz'" in refused("mismatch diagnose rec/data.npz", folder)


@pytest.mark.parametrize("bytes_kept", [0, 10, 200, -30])
def test_a_truncated_scan_is_refused(folder: Path, bytes_kept: int) -> None:
    path = folder / "scan.npz"
    np.savez(path, stroke_um=np.zeros((20, 3)), tip_um=np.zeros((20, 3)))
    path.write_bytes(path.read_bytes()[:bytes_kept])
    assert "cannot be read as .npz" in refused("calibrate manipulator scan.npz --out x.toml", folder)


@pytest.mark.parametrize(
    "words",
    [
        "mismatch simulate {}",
        "mismatch plan {}",
        "mismatch apply rec {} --out twin.toml",
        "noise {}",
        "replay {}",
        "run --virtual --bench {}",
        "run --virtual --hand {}",
        "trust {}",
    ],
)
def test_a_name_that_the_system_refuses_is_one_line(folder: Path, words: str) -> None:
    name = 300 * "n" + ".toml"
    assert name in refused(words.format(name), folder)


def test_an_error_of_the_system_names_its_file(capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(typer.Exit) as caught, clear_errors():
        raise PermissionError(13, "Permission denied", "locked/data.csv")
    assert caught.value.exit_code == Exit.BAD_INPUT
    assert "locked/data.csv: cannot be used (Permission denied); name another file" in capsys.readouterr().err
    with pytest.raises(BrokenPipeError), clear_errors():
        raise BrokenPipeError


def test_an_unreadable_recording_of_a_folder_is_a_row_of_the_table(
    folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    read = Path.read_text

    def locked(path: Path, *arguments: str, **options: str) -> str:
        if path.name == "locked.toml":
            raise PermissionError(13, "Permission denied", str(path))
        return read(path, *arguments, **options)

    (folder / "all").mkdir()
    (folder / "all" / "locked.toml").write_text("format = 1\n")
    monkeypatch.setattr(Path, "read_text", locked)
    done = micron("mismatch", "diagnose", "all", "--jobs", "1")
    assert done.exit_code == Exit.BAD_INPUT
    assert "Permission denied" in " ".join(done.stdout.split())


@pytest.mark.parametrize(
    ("named", "is_noted"),
    [("elsewhere/recording.toml", True), ("rec/recording.toml", False), ("recording.toml", False), (None, False)],
)
def test_a_report_that_names_another_recording_is_noted(folder: Path, named: str | None, is_noted: bool) -> None:
    (folder / "report.json").write_text(json.dumps({**missing_physics().to_json(), "recording": named}))
    done = micron("mismatch", "apply", "rec", "report.json", "--out", "twin.toml")
    assert done.exit_code == 0, done.output
    assert ("note: the report names the recording elsewhere" in done.stderr) is is_noted
