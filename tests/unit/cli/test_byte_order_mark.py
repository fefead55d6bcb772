"""Text files that an editor began with a byte order mark are read as if it were not there."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import pytest

from tests.command import micron
from tests.unit.mismatch_report.canned import missing_physics
from tests.unit.mismatch_report.systems import recording

ROOT = Path(__file__).parents[3]
HAND = "t_s,x_um,y_um,z_um\n" + "".join(f"{i / 500},{i % 7},{i % 5},{i % 3}\n" for i in range(2000))


@pytest.fixture
def place(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    recording(tmp_path / "rec", change=lambda u, t: 0.125 * u - 1.0, samples=300)
    (tmp_path / "report.json").write_text(json.dumps(missing_physics().to_json()))
    shutil.copytree(ROOT / "benches", tmp_path / "benches")
    (tmp_path / "hand.csv").write_text(HAND)
    monkeypatch.chdir(tmp_path)
    return tmp_path


@pytest.mark.parametrize(
    ("file", "words"),
    [
        ("rec/recording.toml", "mismatch simulate rec"),
        ("rec/recording.toml", "mismatch cut rec --out whole"),
        ("rec/recording.toml", "noise rec --picture noise.png"),
        ("report.json", "mismatch apply rec report.json --out twin.toml"),
        ("benches/micron.toml", "doctor --bench benches/micron.toml --json -"),
        ("benches/calibration/sensors.toml", "doctor --bench benches/micron.toml --json -"),
        ("hand.csv", "simulate --seconds 3 --hand hand.csv --scale 1"),
    ],
)
def test_a_byte_order_mark_changes_nothing(place: Path, file: str, words: str) -> None:
    (place / file).write_bytes(b"\xef\xbb\xbf" + (place / file).read_bytes())
    done = micron(*words.split())
    assert done.exit_code in ((0, 1) if words.startswith("doctor") else (0,)), done.output


@pytest.mark.parametrize("ending", [".toml", ".py"])
def test_a_twin_with_a_byte_order_mark_runs(place: Path, ending: str) -> None:
    twin = place / f"twin{ending}"
    assert micron("mismatch", "apply", "rec", "report.json", "--out", twin.name).exit_code == 0
    twin.write_bytes(b"\xef\xbb\xbf" + twin.read_bytes())
    done = micron("mismatch", "simulate", twin.name, "rec", "--trust")
    assert done.exit_code == 0, done.output


def test_text_of_16_bits_is_refused_with_what_to_do(place: Path) -> None:
    text = place / "rec" / "recording.toml"
    text.write_bytes(text.read_text().encode("utf-16"))
    done = micron("mismatch", "simulate", "rec")
    assert done.exit_code == 2
    assert "save it as UTF-8" in done.stderr
