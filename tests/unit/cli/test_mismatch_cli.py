"""``micron mismatch``: what goes to which stream, exit codes, bad input, nothing half written."""

import json
import re
import subprocess
import sys
import tomllib
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner

from tests.unit.mismatch_report.canned import all_verdicts, missing_physics
from tests.unit.mismatch_report.contract_check import NAMES, faults
from tests.unit.mismatch_report.systems import TWIN, recording
from tools.cli.main import app
from tools.mismatch.export.run import free_run
from tools.mismatch.recording_load import descriptor, load
from tools.research.prove.proof import ProofResult

runner = CliRunner()


def straight(u, t):
    return 0.125 * u - 1.0


@pytest.fixture
def stack(tmp_path: Path) -> Path:
    return recording(tmp_path / "stack", change=straight, samples=300).parent


@pytest.fixture
def engine(monkeypatch: pytest.MonkeyPatch) -> dict:
    """Canned reports in place of the engine; what it was asked for."""
    asked: dict = {"report": replace(missing_physics(), pictures=None)}

    def diagnose(rec, *, progress=None, **options):
        asked.update(options, recording=rec)
        if progress is not None:
            progress("step 1: screen", 3, 9)
        return asked["report"]

    monkeypatch.setattr("tools.mismatch.infer.diagnose", diagnose)
    return asked


def run(*words: object):
    return runner.invoke(app, ["mismatch", *map(str, words)])


def files(folder: Path) -> list[str]:
    return sorted(str(p.relative_to(folder)) for p in folder.rglob("*") if p.is_file())


@pytest.mark.parametrize("verdict", ["agrees", "recalibrate", "missing_physics", "unexplained"])
def test_diagnose_exits_0_whatever_the_verdict(stack: Path, engine: dict, verdict: str):
    engine["report"] = all_verdicts()[verdict]
    result = run("diagnose", stack, "--held-out", 0.4, "--seed", 7, "--jobs", 1)
    assert result.exit_code == 0
    assert engine["report"].summary.split(":")[0][:40] in result.stdout
    assert "step 1" not in result.stdout
    assert (engine["held_out"], engine["seed"], engine["jobs"]) == (0.4, 7, 1)


def test_json_and_html_and_out(tmp_path: Path, stack: Path, engine: dict):
    result = run(
        "diagnose", stack, "--json", tmp_path / "r.json", "--html", tmp_path / "r.html", "--out", tmp_path / "o"
    )
    assert result.exit_code == 0
    body = json.loads((tmp_path / "r.json").read_text())
    assert faults(body) == []
    assert json.loads((tmp_path / "o" / "report.json").read_text()) == body
    assert (tmp_path / "o" / "report.html").read_text() == (tmp_path / "r.html").read_text()


def test_json_to_standard_output_is_json_alone(stack: Path, engine: dict):
    result = run("diagnose", stack, "--json", "-")
    assert faults(json.loads(result.stdout)) == []
    assert "What is missing" in result.stderr


def test_notes_of_the_recording_are_said_beside(stack: Path, engine: dict):
    text = stack / "recording.toml"
    text.write_text(text.read_text().replace("format = 1", "format = 1\nplace = '[lab]'"))
    result = run("diagnose", stack)
    assert "key 'place' is unknown" in result.stderr
    assert "unknown" not in result.stdout


def test_a_folder_of_recordings_is_a_table(tmp_path: Path, engine: dict):
    for name in ("a", "b"):
        recording(tmp_path / "in" / name, change=straight, samples=300)
    result = run("diagnose", tmp_path / "in", "--out", tmp_path / "out", "--json", tmp_path / "all.json", "--jobs", 1)
    assert result.exit_code == 0
    assert files(tmp_path / "out") == ["a/report.html", "a/report.json", "b/report.html", "b/report.json"]
    body = json.loads((tmp_path / "all.json").read_text())
    assert [faults(r["report"]) for r in body["recordings"]] == [[], []]
    assert result.stdout.count("creep") == 2


def test_one_bad_recording_of_a_folder_is_said_and_the_others_done(tmp_path: Path, engine: dict):
    recording(tmp_path / "in" / "a", change=straight, samples=300)
    (tmp_path / "in" / "b.toml").write_text("format = 1\nchannels = []\n")
    result = run("diagnose", tmp_path / "in", "--out", tmp_path / "out", "--jobs", 1)
    assert result.exit_code == 2
    assert "1 of 2 recordings have no report" in result.stderr
    assert files(tmp_path / "out") == ["a/report.html", "a/report.json"]


def test_an_engine_failure_in_a_folder_is_exit_1(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    def fails(rec, **_):
        raise ZeroDivisionError("x")

    monkeypatch.setattr("tools.mismatch.infer.diagnose", fails)
    recording(tmp_path / "a", change=straight, samples=300)
    assert run("diagnose", tmp_path, "--jobs", 1).exit_code == 1


def report_file(folder: Path, **changes: object) -> Path:
    path = folder / "report.json"
    path.write_text(json.dumps({**missing_physics().to_json(), **changes}))
    return path


def test_apply_writes_a_twin_that_loads(tmp_path: Path, stack: Path):
    result = run("apply", stack, report_file(tmp_path), "--out", tmp_path / "twin.toml")
    assert result.exit_code == 0, result.stderr
    assert "piezo_stack with creep" in result.stderr
    twin = tomllib.loads((tmp_path / "twin.toml").read_text())["twin"]
    assert twin["effects"][0]["parameters"] == {"rest": 50.0, "c1": 0.001, "c2": 0.004, "c3": 0.002}


def _stack_with(folder: Path, old: str, new: str) -> Path:
    path = recording(folder / "bad", change=straight, samples=300)
    path.write_text(path.read_text().replace(old, new))
    return path


BAD_DIAGNOSE = {
    "missing file": (lambda f: ["nowhere"], "nowhere: no such recording"),
    "not TOML": (lambda f: [_stack_with(f, "format = 1", "format = = 1")], "not valid TOML"),
    "wrong unit": (lambda f: [_stack_with(f, 'unit = "V"', 'unit = "parsec"')], "parsec"),
    "unit of another dimension": (lambda f: [_stack_with(f, 'unit = "um"', 'unit = "kg"')], "unit 'kg'"),
    "missing column": (lambda f: [_stack_with(f, 'column = "z"', 'column = "q"')], "'q'"),
    "unknown twin": (lambda f: [_stack_with(f, '"piezo_stack"', '"flux_capacitor"')], "flux_capacitor"),
    "unknown parameter": (lambda f: [_stack_with(f, "offset_um", "offset_inch")], "offset_inch"),
    "unknown effect": (
        lambda f: [_stack_with(f, TWIN, TWIN + '[[twin.effects]]\nname = "stiction"\n')],
        "'stiction' is not in the vocabulary",
    ),
    "no folder for json": (lambda f: [f / "stack", "--json", f / "no" / "r.json"], "does not exist; create it first"),
    "json is a folder": (lambda f: [f / "stack", "--json", f], "is a folder; name a file"),
    "html is a folder": (lambda f: [f / "stack", "--html", f], "is a folder; name a file"),
    "no folder for out": (lambda f: [f / "stack", "--out", f / "no" / "o"], "does not exist; create it first"),
    "out is a file": (lambda f: [f / "stack", "--out", f / "stack" / "data.npz"], "is a file; name a folder"),
    "dask for one": (lambda f: [f / "stack", "--dask", "tcp://127.0.0.1:1"], "--dask spreads a folder"),
    "no cluster for several together": (
        lambda f: [f / "stack", _stack_with(f, TWIN, TWIN), "--together", "--dask", "tcp://127.0.0.1:1"],
        "no Dask scheduler answers there",
    ),
    "html for many": (lambda f: [f, "--html", f / "r.html"], "use --out FOLDER"),
    "empty folder": (lambda f: [f / "empty"], "no recording.toml"),
    "held-out too large": (lambda f: [f / "stack", "--held-out", "0.9"], "held-out"),
    "negative seed": (lambda f: [f / "stack", "--seed", "-1"], "seed"),
    "no processes": (lambda f: [f / "stack", "--jobs", "0"], "jobs"),
}


@pytest.mark.parametrize("case", list(BAD_DIAGNOSE))
def test_bad_input_of_diagnose(tmp_path: Path, case: str):
    recording(tmp_path / "stack", change=straight, samples=300)
    (tmp_path / "empty").mkdir()
    words, message = BAD_DIAGNOSE[case]
    arguments = words(tmp_path)
    before = files(tmp_path)
    result = run("diagnose", *arguments)
    assert result.exit_code == 2
    assert message in result.stderr.replace("\n", " ")
    assert result.stdout == ""
    assert files(tmp_path) == before
    if result.stderr.startswith("micron:"):
        assert len(result.stderr.strip().splitlines()) == 1


BAD_APPLY = {
    "no report": (lambda f: f / "nowhere.json", "cannot be read"),
    "not JSON": (lambda f: f / "stack" / "recording.toml", "not JSON"),
    "binary": (lambda f: f / "stack" / "data.npz", "not JSON"),
    "a list": (lambda f: _write(f, "[]"), "not a mismatch report"),
    "other format": (lambda f: report_file(f, format=3), "format 3, expected 1"),
    "half a report": (lambda f: _write(f, '{"format": 1, "verdict": "agrees"}'), "no physics, fit, twin"),
    "unknown effect": (
        lambda f: report_file(f, physics=[{**missing_physics().to_json()["physics"][0], "name": "stiction"}]),
        "'stiction' is not in the vocabulary",
    ),
    "other twin": (lambda f: report_file(f, twin="magnetometer"), "of a magnetometer"),
}


def _write(folder: Path, text: str) -> Path:
    (folder / "report.json").write_text(text)
    return folder / "report.json"


@pytest.mark.parametrize("case", list(BAD_APPLY))
def test_bad_input_of_apply(tmp_path: Path, case: str):
    recording(tmp_path / "stack", change=straight, samples=300)
    make, message = BAD_APPLY[case]
    result = run("apply", tmp_path / "stack", make(tmp_path), "--out", tmp_path / "twin.toml")
    assert result.exit_code == 2
    assert message in result.stderr
    assert not (tmp_path / "twin.toml").exists()


def test_apply_needs_a_folder_that_exists(tmp_path: Path, stack: Path):
    result = run("apply", stack, report_file(tmp_path), "--out", tmp_path / "no" / "twin.toml")
    assert result.exit_code == 2
    assert "does not exist; create it first" in result.stderr


def test_physics_names_the_contract_s_vocabulary():
    result = run("physics", "--json", "-")
    assert result.exit_code == 0
    assert [p["name"] for p in json.loads(result.stdout)["physics"]] == list(NAMES)
    assert "hysteresis  rate-independent memory" in run("physics").stdout


def test_physics_prints_the_named_effects_alone():
    text = run("physics", "overflow", "creep").stdout
    assert [line.split()[0] for line in text.splitlines() if line[:1].isalpha()][:2] == ["creep", "overflow"]
    assert "backlash  free play" not in text
    assert " ".join(text.split()).count("where adds a flow of what a state stores") == 1
    result = run("physics", "creap")
    assert result.exit_code == 2
    assert "no effect 'creap'; write 'creep'" in result.stderr


def test_prove_prints_its_table_and_writes_json(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    asked = {}

    def prove(cases, seed, jobs, folder, *, progress, **options):
        asked.update(cases=cases, seed=seed, jobs=jobs, folder=folder)
        progress("answers sealed, sha256 [abc]")
        return ProofResult(5, "abc", (), {}, 1.0, tmp_path)

    monkeypatch.setattr("tools.research.prove.prove", prove)
    monkeypatch.setattr("tools.research.prove.table.show", lambda result, console: console.print("the table"))
    result = run("prove", "--cases", 12, "--seed", 5, "--jobs", 1, "--json", tmp_path / "p.json")
    assert result.exit_code == 0, result.stderr
    assert asked == {"cases": 12, "seed": 5, "jobs": 1, "folder": None}
    assert "sealed, sha256 [abc]" in result.stderr
    assert result.stdout == "the table\n"
    assert json.loads((tmp_path / "p.json").read_text())["answers_sha256"] == "abc"


def test_help_does_not_wait_for_the_engine():
    code = (
        "import sys; from tools.cli import mismatch;"
        "print([m for m in sys.modules if m.startswith(('numba', 'scipy', 'matplotlib', 'tools.mismatch'))])"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "[]"


@pytest.mark.parametrize("command", ["diagnose", "physics", "prove", "apply"])
def test_every_command_has_an_example(command: str):
    assert f"micron mismatch {command}" in " ".join(run(command, "--help").stdout.split())


@pytest.mark.parametrize(
    ("options", "text"),
    [
        (("--corpus", "mine"), "use calibrate, develop, sealed"),
        (("--corpus", "develop", "--seed", 3), "leave --seed out"),
    ],
)
def test_prove_says_what_is_wrong_with_a_corpus(options: tuple[object, ...], text: str):
    result = run("prove", "--cases", 1, *options)
    assert result.exit_code == 2
    assert text in " ".join(result.stderr.split())


def test_one_recording_and_a_folder_get_the_same_kind_of_report(stack: Path, tmp_path: Path):
    result = run("diagnose", stack, "--jobs", 1, "--json", tmp_path / "r.json")
    assert result.exit_code == 0, result.stderr
    assert json.loads((tmp_path / "r.json").read_text())["verdict"] in ("agrees", "recalibrate")
    many = run("diagnose", stack.parent, "--jobs", 1, "--json", tmp_path / "all.json")
    assert many.exit_code == 0, many.stderr
    (row,) = json.loads((tmp_path / "all.json").read_text())["recordings"]
    assert row["report"]["verdict"] in ("agrees", "recalibrate")


def test_a_calibration_that_is_not_finished_says_how_to_go_on(tmp_path: Path):
    result = run("calibrate", "--keep", tmp_path / "kept", "--cases", 8, "--samples", 1000, "--minutes", 0)
    assert result.exit_code == 0, result.stderr
    assert "8 of 8 cases are still to be done; run the same command again" in " ".join(result.stderr.split())


def test_simulate_of_a_recording_runs_its_own_twin_and_says_what_was_read(stack: Path):
    result = run("simulate", stack, "--json", "-")
    assert result.exit_code == 0
    (row,) = json.loads(result.stdout)["outputs"]
    loaded = load(stack)
    (o,) = loaded.outputs
    away = loaded.outputs[o] - free_run(loaded)[o]
    assert row["rms"] == pytest.approx(float(np.sqrt(np.mean(away**2))))
    assert row["share"] == pytest.approx(row["rms"] / float(np.std(loaded.outputs[o])))
    assert f"samples: 300 at {1 / loaded.dt:g} Hz" in result.stderr
    assert "inputs: command (V, hold" in result.stderr


def test_simulate_draws_recorded_simulated_and_residual(stack: Path, tmp_path: Path):
    result = run("simulate", stack, "--picture", tmp_path / "run.svg")
    assert result.exit_code == 0
    drawn = (tmp_path / "run.svg").read_text()
    assert "<!-- recorded less simulated -->" in drawn
    assert {"<!-- recorded -->", "<!-- simulated -->"} <= set(re.findall("<!-- [a-z]+ -->", drawn))
    refused = run("simulate", stack, "--picture", tmp_path / "run.txt")
    assert refused.exit_code == 2
    assert "a picture ends in" in refused.stderr


def test_simulate_runs_on_other_data_with_the_columns_of_the_recording(stack: Path, tmp_path: Path):
    other = recording(tmp_path / "other", change=straight, samples=200)
    data = other.parent / descriptor(other)["data"]
    expected = json.loads(run("simulate", other.parent, "--json", "-").stdout)
    result = run("simulate", stack, "--data", data, "--json", "-")
    assert result.exit_code == 0
    assert "samples: 200 at" in result.stderr
    assert json.loads(result.stdout)["outputs"] == expected["outputs"]
    refused = run("simulate", stack, "--data", tmp_path / "nothing.csv")
    assert refused.exit_code == 2
    assert "nothing.csv" in refused.stderr


def test_simulate_of_no_recording_is_bad_input(tmp_path: Path):
    result = run("simulate", tmp_path / "nothing")
    assert result.exit_code == 2
    assert "no such recording" in result.stderr
