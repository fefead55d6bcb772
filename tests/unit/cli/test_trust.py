"""A stranger's folder runs nothing and reads nothing outside before the user says so, and says how to decide."""

from __future__ import annotations

import shlex
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from typer.testing import CliRunner

from hal import trust
from hal.bench import load_bench
from hal.errors import BenchError
from tools.cli import main
from tools.cli.common import DECIDING
from tools.cli.main import COMMANDS, app
from tools.cli.trust import decide_on
from tools.errors import RecordingError
from tools.mismatch.recording_load import load
from tools.mismatch.twins.make import make
from tools.programs import named_in

ROOT = Path(__file__).parents[3]
RECORDING = """format = 1
data = "{data}"
rate_hz = 100
[twin]
kind = "ode"
function = "{function}"
states = {{ speed = "rad/s" }}
parameters = {{ gain = 2.0 }}
[[channels]]
column = "u"
role = "input"
signal = "u"
[[channels]]
column = "speed"
role = "output"
signal = "speed"
unit = "rad/s"
"""
TWIN = "def rates(t, states, inputs, parameters):\n    return {{'speed': parameters['gain'] * inputs['u']}}\n{more}"


@pytest.fixture(autouse=True)
def no_decisions(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.setenv("XDG_STATE_HOME", str(tmp_path / "state"))
    return tmp_path / "state" / "micron-bench" / "trust.jsonl"


def stranger(folder: Path, more: str = "", data: str = "data.csv", function: str = "twin.py:rates") -> Path:
    folder.mkdir(exist_ok=True)
    t = np.arange(200) * 0.01
    rows = np.column_stack([np.cos(9 * t), np.sin(9 * t) / 4.5])
    np.savetxt(folder / "data.csv", rows, "%.9g", ",", header="u,speed", comments="")
    (folder / "twin.py").write_text(TWIN.format(more=more))
    (folder / "recording.toml").write_text(RECORDING.format(data=data, function=function))
    return folder


def micron(monkeypatch: pytest.MonkeyPatch, *words: str) -> tuple[int, str]:
    monkeypatch.setattr("sys.argv", ["micron", *words])
    done = CliRunner().invoke(app, list(words))
    return done.exit_code, done.output


def test_a_strangers_twin_does_not_run_and_the_message_says_how_it_would(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    mark = tmp_path / "mark"
    folder = stranger(tmp_path / "her's", f"open({str(mark)!r}, 'w').close()\n")
    code, said = micron(monkeypatch, "mismatch", "diagnose", str(folder))
    assert code == 2
    assert not mark.exists()
    assert said.count("micron:") == 1
    assert "names the program" in said
    command = shlex.split(said.rpartition("repeat: ")[2])
    assert command == ["micron", "mismatch", "diagnose", str(folder), "--trust"]
    with pytest.raises(trust.NotTrusted):
        make(load(folder))
    # that command's option is all that is needed, and once is enough
    decide_on([folder], True, False)
    make(load(folder))
    assert mark.exists()


def test_a_decision_ends_when_the_content_changes(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    folder = stranger(tmp_path / "rec")
    assert micron(monkeypatch, "trust", str(folder))[0] == 0
    make(load(folder))
    (folder / "twin.py").write_text(TWIN.format(more="x = 1\n"))
    with pytest.raises(trust.NotTrusted):
        make(load(folder))
    code, said = micron(monkeypatch, "trust")
    assert code == 0
    assert "twin.py" in said
    assert "1 decisions dropped" in micron(monkeypatch, "trust", "--forget")[1]
    assert not list(trust.decisions())


@pytest.mark.parametrize(("answer", "runs"), [("y\n", True), ("n\n", False), ("\n", False)])
def test_on_a_terminal_it_asks(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, answer: str, runs: bool) -> None:
    folder = stranger(tmp_path / "rec")
    asked: list[str] = []

    def confirm(question: str, **options: object) -> bool:
        asked.append(question)
        assert options["default"] is False
        return answer.startswith("y")

    monkeypatch.setattr("tools.cli.trust.typer.confirm", confirm)
    monkeypatch.setattr("sys.stdin", type("Terminal", (), {"isatty": lambda self: True})())
    decide_on([folder], False, False)
    assert len(asked) == 1
    assert "twin.py" in asked[0]
    assert next(iter(named_in(folder))).is_trusted == runs


def test_a_crash_of_a_trusted_twin_is_a_message(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    folder = stranger(tmp_path / "rec", "import os\nos.abort()\n")
    code, said = micron(monkeypatch, "mismatch", "diagnose", str(folder), "--trust")
    assert code == 2
    assert "crashed (SIGABRT)" in said
    assert "Traceback" not in said


@pytest.mark.parametrize("how", ["dots", "absolute", "link"])
def test_a_name_outside_the_folder_is_refused_until_it_is_allowed(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, how: str
) -> None:
    secret = tmp_path / "secret.csv"
    data = {"dots": "../secret.csv", "absolute": str(secret), "link": "link.csv"}[how]
    folder = stranger(tmp_path / "rec", data=data)
    (folder / "data.csv").rename(secret)
    (folder / "link.csv").symlink_to(secret)
    code, said = micron(monkeypatch, "mismatch", "diagnose", str(folder), "--trust")
    assert code == 2
    assert "lies outside its folder" in said
    assert said.strip().endswith("--trust --allow-outside")
    with pytest.raises(trust.NotTrusted):
        load(folder)
    decide_on([folder], True, True)
    assert load(folder).n == 200


def test_a_function_outside_is_refused_too(tmp_path: Path) -> None:
    folder = stranger(tmp_path / "rec", function="../other.py:rates")
    (tmp_path / "other.py").write_text(TWIN.format(more=""))
    with pytest.raises(trust.NotTrusted, match="outside its folder"):
        make(load(folder))


@pytest.mark.parametrize("signal", ['u"', "u\\\\", "u\\u001b"])
def test_names_that_would_be_code_in_an_exported_twin_are_refused(tmp_path: Path, signal: str) -> None:
    folder = stranger(tmp_path / "rec")
    text = (folder / "recording.toml").read_text()
    quoted = f"'{signal}'" if '"' in signal else f'"{signal}"'
    (folder / "recording.toml").write_text(text.replace('signal = "u"', f"signal = {quoted}"))
    with pytest.raises(RecordingError, match="quotes, backslashes or unprintable"):
        load(folder)


def bench(folder: Path, **changes: str) -> Path:
    text = (ROOT / "benches" / "micron.toml").read_text()
    for old, new in changes.values():
        assert old in text
        text = text.replace(old, new)
    path = folder / "bench.toml"
    path.write_text(text.replace('"calibration/', f'"{ROOT}/benches/calibration/'))
    return path


def test_a_provider_of_a_stranger_is_not_imported(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    mark = tmp_path / "mark"
    (tmp_path / "hers.py").write_text(f"open({str(mark)!r}, 'w').close()\nprovider = 1\n")
    monkeypatch.syspath_prepend(str(tmp_path))
    path = bench(tmp_path, provider=("sim_devices.register:provider", "hers:provider"))
    with pytest.raises(trust.NotTrusted, match="hers:provider"):
        load_bench(path)
    code, said = micron(monkeypatch, "doctor", "--bench", str(path))
    assert code == 2
    assert shlex.split(said.partition("author: ")[2].partition(";")[0]) == ["micron", "trust", str(path)]
    assert not mark.exists()
    assert micron(monkeypatch, "trust", str(path))[0] == 0
    assert not mark.exists()
    assert load_bench(path).path == path


def test_a_bench_names_files_of_its_folder_and_ours(tmp_path: Path) -> None:
    assert load_bench(bench(tmp_path)).resolve("calibration/x.toml").parent == tmp_path / "calibration"
    outside = tmp_path / "elsewhere" / "piezo.toml"
    (tmp_path / "lab").mkdir()
    path = bench(tmp_path / "lab", calibration=('"calibration/piezo.toml"', f'"{outside}"'))
    with pytest.raises(trust.NotTrusted, match="outside its folder"):
        load_bench(path)
    trust.allow_name(outside)
    load_bench(path)
    with pytest.raises(BenchError, match="no path"):
        load_bench(path).resolve("a\0b")


def test_nothing_is_decided_about_our_own_code(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "bench.toml").write_text((ROOT / "benches" / "imus.toml").read_text())
    code, said = micron(monkeypatch, "trust", str(tmp_path / "bench.toml"))
    assert code == 0
    assert "names no program of others and no file outside its folder" in " ".join(said.split())
    assert not list(trust.decisions())


def test_our_own_examples_need_no_decision() -> None:
    for path in sorted((ROOT / "benches").glob("micron*.toml")):
        assert all(item.is_trusted for item in named_in(path)), path
    assert all(item.is_trusted for item in named_in(ROOT / "examples"))


def test_the_commands_that_take_the_options_are_those_that_advise_them() -> None:
    def walk(command: Any, name: tuple[str, ...]) -> Iterator[tuple[str, ...]]:
        if {"--trust", "--allow-outside"} <= {o for p in command.params for o in p.opts}:
            yield name
        for inner, its in getattr(command, "commands", {}).items():
            yield from walk(its, (*name, inner))

    found = {name for top in COMMANDS for name in walk(main.load(top), (top,))}
    assert found == set(DECIDING)


def test_a_torn_file_of_decisions_decides_nothing(no_decisions: Path) -> None:
    trust.decide("run", "abc", "x")
    no_decisions.write_text("{}\nnull\n[]\n\x00\n" + no_decisions.read_text() + '{"act": "run", "key": "tor')
    assert [d.key for d in trust.decisions()] == ["abc"]
    assert no_decisions.stat().st_mode & 0o077 == 0
