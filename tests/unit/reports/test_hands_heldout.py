"""``micron hands --heldout``: which recordings of a folder are scored, what is refused, what the page says."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner

from hal.bench import load_bench
from tests.conftest import DEFAULT_BENCH
from tools.cli.main import app
from tools.errors import InputError
from tools.reports.figures import FOUR_BANDS_HZ, BandFigures, TremorFigures
from tools.research.reports import hands_heldout
from tools.research.reports.hand_limits import Swing
from tools.research.reports.hands import HandRow
from tools.research.reports.hands_heldout import Folder, Source, development_sums, find_recordings, heldout_page


def trembling(
    seconds: float = 8.0, rate_hz: float = 100.0, hz: float = 9.5, size_g: float = 0.02
) -> dict[str, np.ndarray]:
    t = np.arange(round(seconds * rate_hz)) / rate_hz
    return {
        "t_s": t,
        "acc_x_g": size_g * np.sin(2 * np.pi * hz * t),
        "acc_y_g": size_g * np.sin(2 * np.pi * hz * t + 1),
    }


def write_csv(path: Path, columns: dict[str, np.ndarray]) -> Path:
    path.parent.mkdir(parents=True, exist_ok=True)
    np.savetxt(path, np.stack(list(columns.values()), axis=1), delimiter=",", header=",".join(columns), comments="")
    return path


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """A .csv, a long .npz, one .npz of two named recordings, a recording folder of the contract."""
    there = tmp_path / "hands"
    write_csv(there / "anna.csv", trembling())
    np.savez(there / "bert.npz", **trembling(100.0))
    two = trembling(16.0)
    two["recording_id"] = np.repeat([1, 2], 800)
    two["t_s"] = np.tile(trembling()["t_s"], 2)
    (there / "both").mkdir()
    np.savez(there / "both" / "data.npz", **two)
    (there / "both" / "index.csv").write_text("recording_id,name\n1,left\n2,right\n")
    write_csv(there / "contract" / "data.csv", trembling(hz=9.0))
    (there / "contract" / "recording.toml").write_text(
        'format = 1\ndata = "data.csv"\ntime_column = "t_s"\n[[channels]]\ncolumn = "acc_x_g"\nrole = "output"\n'
        'signal = "x"\nunit = "g"\n'
    )
    return there


def found(folder: Path) -> Folder:
    return find_recordings(folder, load_bench(DEFAULT_BENCH))


def test_every_recording_is_found_once_and_long_ones_are_cut_to_their_middle(folder: Path) -> None:
    sources = found(folder).sources
    assert [s.name for s in sources] == [
        "anna.csv", "bert.npz", "both/data.npz#left", "both/data.npz#right", "contract/recording.toml",
    ]  # fmt: skip
    assert sources[1].address == f"{folder / 'bert.npz'}#20:80"
    assert sources[1].seconds == pytest.approx(100.0, abs=0.05)
    assert sources[0].address == str(folder / "anna.csv")


def test_files_without_motion_are_left_out_and_named(folder: Path, tmp_path: Path) -> None:
    cursor = {"t_s": trembling()["t_s"], "cursor_px": trembling()["t_s"]}
    write_csv(folder / "cursor.csv", cursor)
    assert found(folder).no_hands == ("cursor.csv",)
    assert len(found(folder).sources) == 5
    write_csv(tmp_path / "alone" / "cursor.csv", cursor)
    with pytest.raises(InputError, match=r"holds no recording \(no motion in cursor\.csv\)"):
        found(tmp_path / "alone")


def test_recordings_that_settings_were_chosen_on_are_left_out(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    seen = hands_heldout._sum(folder / "anna.csv")
    monkeypatch.setattr(hands_heldout, "development_sums", lambda: {seen: "known.csv"})
    (folder / "anna.csv").rename(folder / "another-name.csv")
    got = found(folder)
    assert got.development == ("another-name.csv",)
    assert "another-name.csv" not in [s.name for s in got.sources]
    for other in ("bert.npz", "both", "contract"):
        path = folder / other
        path.unlink() if path.is_file() else [p.unlink() for p in path.iterdir()]
    with pytest.raises(InputError, match=r"holds only recordings that settings were chosen on \(another-name\.csv\)"):
        found(folder)


def test_the_list_names_the_recordings_of_the_other_table(shared_data: Path) -> None:
    """Every file of ``micron hands`` is development data; its sums are those of the files."""
    from tools.research.reports.hands import HANDS

    listed = development_sums()
    for _, source in HANDS:
        file = source.split("#")[0]
        assert listed[hands_heldout._sum(shared_data / file)] == file


@pytest.mark.parametrize(
    ("spoil", "said"),
    [
        (lambda f: write_csv(f / "anna.csv", trembling(2.0)), "anna.csv: 2.00 s of motion; a hand needs 4 s"),
        (lambda f: write_csv(f / "anna.csv", trembling(size_g=0.0)), "nothing moves in 8 to 12 Hz"),
        (lambda f: (f / "anna.csv").write_text("t_s,acc_x_g\n0,1\n0.01\n"), "anna.csv line 3: 1 values"),
        (lambda f: (f / "bert.npz").write_bytes(b"PK\x03\x04 torn"), "bert.npz is not a readable .npz"),
        (lambda f: (f / "contract" / "data.csv").unlink(), "data.csv does not exist"),
        (lambda f: (f / "contract" / "recording.toml").write_text("data = ["), "recording.toml"),
    ],
)
def test_bad_input_is_one_message_and_status_2(folder: Path, tmp_path: Path, spoil, said: str) -> None:
    spoil(folder)
    page = tmp_path / "page.md"
    result = CliRunner().invoke(app, ["hands", "--heldout", str(folder), "--out", str(page)])
    text = " ".join(result.output.split())
    assert result.exit_code == 2, text
    assert said in text
    assert "Traceback" not in text
    assert not page.exists()


def test_folders_without_hands_are_refused(tmp_path: Path) -> None:
    for there, said in ((tmp_path / "none", "no such folder"), (tmp_path, "holds no recording")):
        result = CliRunner().invoke(app, ["hands", "--heldout", str(there)])
        assert result.exit_code == 2
        assert said in " ".join(result.output.split())


def row(hand: str, with_um: float, stroke_um: float) -> HandRow:
    vector = BandFigures(20.0, with_um, 100.0 * (1.0 - with_um / 20.0))
    bands = {band: BandFigures(0.1 + n, 2.3 + n, -1.0) for n, band in enumerate(FOUR_BANDS_HZ)}
    figures = TremorFigures((8.0, 12.0), (5.0, 40.0), vector, {}, vector, bands, 1.0, 0.0)
    return HandRow(hand, "-", "adaptive", figures, 1.5, stroke_um, 2.0, Swing(14.0, 3.0, 0.3, 74.0, 5.0), 30.0)


def test_the_page_judges_hands_that_fit_and_says_what_the_stroke_leaves_of_others() -> None:
    rows = [row("good", 4.0, 0.5), row("missed", 8.0, 1.0), row("wide", 9.0, 5.0)]
    page = heldout_page(Folder(Path("hands"), (Source("good", "good", 30.0),), ("seen.npz",)), rows, 40.0, "abc")
    others = "0.1 -> 2.3 | 1.1 -> 3.3 | 3.1 -> 5.3"
    assert f"| good | 30 | 20.00 | 4.00 | 80.0 | 97.5 | 90.0 | yes | {others} |" in page
    assert "## Spectrum of the error" in page
    assert "reached in 1 of 2." in page
    assert "Left out, because settings were chosen on them: seen.npz." in page
    assert "wide: its tremor does not fit. The stroke alone would leave 5.0 of 20.0 um (25 %)" in page
    assert "Missed: 30 % of the tremor's power is one swing from 14 to 17 s" in " ".join(page.split())
    assert "Good:" not in page


@pytest.mark.slow
def test_a_folder_is_run_from_the_command_line(folder: Path, tmp_path: Path) -> None:
    for name in ("bert.npz", "anna.csv"):
        (folder / name).unlink()
    out = tmp_path / "out.json"
    result = CliRunner().invoke(app, ["hands", "--heldout", str(folder), "--seconds", "12", "--json", str(out)])
    assert result.exit_code == 0, result.output
    rows = json.loads(out.read_text())["rows"]
    assert [r["hand"] for r in rows] == ["both/data.npz#left", "both/data.npz#right", "contract/recording.toml"]
    assert {r["method"] for r in rows} == {"adaptive"}
    assert "| both/data.npz#left | 8 |" in result.output
