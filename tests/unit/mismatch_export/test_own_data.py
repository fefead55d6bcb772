"""``docs/own-data.md``: made by its command, and what it tells a stranger to do works in an empty folder."""

from __future__ import annotations

import json
import math
import re
import shlex
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner

from sim_devices.physics.catalogue import EFFECTS
from tests.unit.mismatch_model.made import recording
from tools.cli.main import app
from tools.errors import RecordingError
from tools.guest.equations import FUNCTIONS, NUMPY_FUNCTIONS, Builder, EquationError, trace
from tools.mismatch import key_tables as keys
from tools.mismatch import recording_channels, recording_load, recording_ranges
from tools.mismatch.export.write import FORMATS
from tools.mismatch.keys import Key
from tools.mismatch.recording_load import load
from tools.mismatch.twins.make import make
from tools.mismatch.twins.program import parse
from tools.mismatch.twins.vocabulary import CONTEXT_UNITS, KINDS
from tools.research.reports.own_data_page import is_allowed, page

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
    make, again, elsewhere = (b for b in blocks("python") if "def derivatives" not in b)
    toml, believed, *_ = blocks("toml")
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


def _cells(row: str) -> list[list[str]]:
    """Return the code of each cell of a row of the table of equations, without its first."""
    line = next(x for x in page().splitlines() if x.startswith(f"| {row} |"))
    return [re.findall(r"`([^`]+)`", cell) for cell in line.split("|")[2:-1]]


def _numbers(name: str) -> str:
    """Return as many arguments as a function takes, as text."""
    two = ("min", "max", "atan2", "arctan2", "minimum", "maximum", "pow")
    return "a, b, c" if name in ("where", "clip") else "a, b" if name in two else "a"


def test_the_functions_of_the_page_are_those_of_the_parser() -> None:
    text, function = _cells("functions")
    assert text == list(FUNCTIONS)
    assert function == [f"np.{name}" for name in NUMPY_FUNCTIONS]
    assert {"abs", "sqrt", "sin", "max", "where", "tanh"} <= set(text)
    for name in text:
        assert is_allowed(f"{name}({_numbers(name)})"), name
    for name in function:
        called = eval(f"lambda t, states, inputs, p: {{'x': {name}({_numbers(name[3:])})}}", {"np": np, **_symbols()})
        trace(Builder(("t",)), called, {"states": (), "inputs": (), "parameters": ()})


def _symbols() -> dict[str, object]:
    from tools.guest.equations import Traced

    builder = Builder(("t", "a", "b", "c"))
    return {name: Traced(builder, k) for k, name in enumerate(builder.names)}


def test_the_operators_of_the_page_are_those_of_the_parser() -> None:
    allowed, refused = _cells("operators")[0], _cells("not allowed")[0]
    assert {"a ** b", "a < b", "a if b else c"} <= set(allowed)
    assert {"a ^ b", "a == b", "a and b"} <= set(refused)
    for text in allowed:
        parse(Builder(("a", "b", "c")), {"x": text}, ["x"])
    for text in refused:
        with pytest.raises(EquationError):
            parse(Builder(("a", "b", "c")), {"x": text}, ["x"])


def test_the_function_of_the_page_becomes_equations() -> None:
    (text,) = (b for b in blocks("python") if "def derivatives" in b)
    space: dict[str, object] = {}
    exec(text, space)
    groups = {"states": ("speed",), "inputs": ("current",), "parameters": ("bearing", "torque_per_A", "inertia")}
    builder = Builder(("t", *(n for names in groups.values() for n in names)))
    derivatives = space["derivatives"]
    assert callable(derivatives)
    assert trace(builder, derivatives, groups).keys() == {"speed"}


def test_python_s_max_is_refused_with_the_remedy() -> None:
    groups = {"states": ("x",), "inputs": (), "parameters": ()}
    with pytest.raises(EquationError, match=r"max and min as numpy\.maximum and numpy\.minimum"):
        trace(Builder(("t", "x")), lambda t, states, inputs, parameters: {"x": max(states["x"], 0.0)}, groups)
    with pytest.raises(EquationError, match=r"use numpy's abs, .*, arctan2, minimum"):
        trace(Builder(("t", "x")), lambda t, states, inputs, parameters: {"x": math.sin(states["x"])}, groups)


def test_the_columns_of_the_page_are_a_twin(tmp_path: Path) -> None:
    shown = next(b for b in blocks("toml") if "simulated_position" in b)
    t = np.arange(300) * 0.01
    np.savetxt(
        tmp_path / "d.csv", np.c_[np.sin(t), np.cos(t)], delimiter=",", header="x_mm,x_mm_simulated", comments=""
    )
    head = 'format = 1\ndata = "d.csv"\nrate_hz = 100.0\n[twin]\nkind = "columns"\n'
    (tmp_path / "recording.toml").write_text(head + shown)
    assert make(load(tmp_path)).outputs == ("position",)


def test_the_page_says_what_a_stranger_asks() -> None:
    text = page()
    for word in ("agrees", "recalibrate", "missing_physics", "unexplained"):
        assert f"`{word}`" in text
    for signal, needed in {"temperature": "temperature_sensitivity", "current": "current_coupling"}.items():
        assert f"| `{signal}` | {CONTEXT_UNITS[signal][0]} | `{needed}` |" in text
    assert f"{recording_load.MIN_SAMPLES} samples are needed" in text
    assert "or, as `states` and `equations` here, in `[twin]`" in text.replace("\n", " ")
    assert all(f"| `{name}` |" in text for name in EFFECTS)


def test_the_command_that_lists_effects_is_named_where_a_stranger_looks() -> None:
    assert "micron mismatch physics" in CliRunner().invoke(app, ["mismatch", "diagnose", "--help"]).output
    assert "`micron mismatch physics`" in (PAGE.parents[1] / "README.md").read_text(encoding="utf-8")
