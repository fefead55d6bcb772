"""``docs/own-data.md``: made by its command, and what it tells a stranger to do works in an empty folder."""

from __future__ import annotations

import json
import re
import shlex
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner

from tests.unit.mismatch_model.made import recording
from tools.cli.main import app
from tools.errors import RecordingError
from tools.mismatch import key_tables as keys
from tools.mismatch import recording_channels, recording_load, recording_ranges
from tools.mismatch.export.write import FORMATS
from tools.mismatch.keys import Key
from tools.mismatch.recording_load import load
from tools.mismatch.twins.make import make
from tools.mismatch.twins.vocabulary import KINDS
from tools.research.reports.own_data_page import page

PAGE = Path(__file__).parents[3] / "docs" / "own-data.md"


def blocks(kind: str) -> list[str]:
    return re.findall(rf"^``` {{ \.{kind}[^\n]*\n(.*?)^```", page(), flags=re.S | re.M)


def test_the_page_is_current() -> None:
    assert PAGE.read_text(encoding="utf-8") == page(), "its head names the command"


def test_every_key_and_every_kind_is_on_the_page() -> None:
    text = page()
    for kind in KINDS:
        assert f"### `{kind}`" in text
        assert keys.of_kind(kind)
    for table in (*(t for _, t in keys.tables()), *map(keys.of_kind, KINDS)):
        for key in table:
            assert f"| `{key.name}` |" in text
            assert key.help
    for ending in FORMATS:
        assert f"- `{ending}`: " in text


@pytest.mark.slow
def test_a_stranger_in_an_empty_folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The blocks of the page in their order: data, what the first command writes, what a person adds, the commands, the
    module elsewhere."""
    monkeypatch.chdir(tmp_path)
    make, again, elsewhere = blocks("python")
    toml, believed, _ = blocks("toml")
    (commands,) = blocks("bash")
    five = commands.strip().splitlines()
    assert len(five) == 5
    exec(make, {})
    for line in five:
        if Path("recording.toml").exists() and believed:
            text = Path("recording.toml").read_text()
            assert text == toml
            for value in believed.strip().splitlines():
                key = re.escape(value.partition(" ")[0])
                text, put = re.subn(rf"^# {key} = #.*$", value, text, flags=re.M)
                assert put == 1, value
            Path("recording.toml").write_text(text)
            believed = ""
        words = shlex.split(line)
        assert words[0] == "micron"
        result = CliRunner().invoke(app, words[1:])
        assert result.exit_code == 0, (line, result.output)
    report = json.loads(Path("report.json").read_text())
    assert [p["name"] for p in report["physics"]] == ["coulomb_friction"]
    space: dict[str, np.ndarray] = {}
    exec(again, space)
    done = subprocess.run(
        [sys.executable, "-c", f"{elsewhere}\nnp.save('elsewhere.npy', [position_mm, heavier])"],
        capture_output=True,
        text=True,
        cwd=tmp_path,
    )
    assert done.returncode == 0, done.stderr
    position, heavier = np.load("elsewhere.npy")
    recorded = load(".").outputs["position"] * 1e3
    base = report["fit"]["base_rms"]["position"] * 1e3
    for found in (space["position_mm"], position):
        assert np.std(recorded - found) < 0.2 * base
    assert np.std(heavier - position) > 0.1 * base
    table = np.genfromtxt("simulated.csv", delimiter=",", names=True)
    assert table.dtype.names == ("t_s", "force_N", "x_mm", "x_mm_simulated")
    np.testing.assert_allclose(table["x_mm_simulated"], position, atol=1e-9)


def test_the_tables_of_the_page_are_those_that_the_loader_knows() -> None:
    assert set(keys.names(keys.TOP)) == set(recording_load.TOP_KEYS)
    assert keys.names(keys.CHANNEL) == recording_channels.KEYS
    assert {k for k in keys.names(keys.SPLIT) if k != "test_NAME"} == set(recording_ranges.SPLIT_KEYS)
    assert keys.names(keys.TWIN) == recording_load.TWIN_KEYS


@pytest.mark.parametrize("hold", ["linear", "zero", "smooth"])
@pytest.mark.parametrize("kind", ["piezo_stack", "mechanical_axis", "state_space", "ode"])
def test_a_hold_is_taken_if_and_only_if_the_page_lists_it(kind: str, hold: str) -> None:
    listed = next(k for k in keys.of_kind(kind) if k.name == "hold").value.split(", ")
    matrices = {"A": [[-2.0]], "B": [[1.0]], "C": [[1.0]]}
    ode = {"states": {"position": "m"}, "equations": {"position": "force - position"}}
    given = {"state_space": matrices, "ode": ode, "mechanical_axis": {"mass": 1.0, "damping": 2.0}}.get(kind, {})
    u, y = ("command", "displacement") if kind == "piezo_stack" else ("force", "position")
    t = np.arange(200) * 0.01
    made = recording(kind, 0.01, {u: np.sin(t)}, {y: np.cos(t)}, {}, {**given, "hold": hold})
    if hold in listed:
        make(made)
    else:
        with pytest.raises(RecordingError, match="hold must be"):
            make(made)


def test_the_equations_of_the_page_are_a_twin(tmp_path: Path) -> None:
    """The page's example of equations loads and builds."""
    shown = next(t for t in re.findall(r"^``` \{ \.toml[^\n]*\n(.*?)^```", page(), re.S | re.M) if '"ode"' in t)
    t = np.arange(300) * 0.01
    np.savez(tmp_path / "data.npz", i=np.sin(t), w=60 * np.cos(t))
    (tmp_path / "recording.toml").write_text(
        f'format = 1\ndata = "data.npz"\nrate_hz = 100.0\n{shown}'
        '[[channels]]\ncolumn = "i"\nrole = "input"\nsignal = "current"\nunit = "A"\n'
        '[[channels]]\ncolumn = "w"\nrole = "output"\nsignal = "speed"\nunit = "rpm"\n'
    )
    found = load(tmp_path)
    assert found.unit["speed"] == "rad/s"
    assert [p.name for p in make(found).parameters] == ["torque_per_A", "bearing", "speed_offset"]


def test_a_key_that_nobody_described_is_listed() -> None:
    """What a parser knows is on the page, whether or not somebody has written a line about it."""
    found = keys.listed((Key("a", "number", "the first"), Key("gone", "number", "was dropped")), {"a", "new"})
    assert [k.name for k in found] == ["a", "new"]
