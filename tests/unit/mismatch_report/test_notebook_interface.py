"""``from tools.mismatch import Recording, Twin, diagnose``: light to import, typed, clear about bad input."""

from __future__ import annotations

import json
import subprocess
import sys
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from tools.errors import InputError
from tools.mismatch import Diagnosis, Recording, Twin, diagnose
from tools.mismatch.recording_load import load

T = np.arange(900) * 0.01
DRIVE = np.sin(2 * np.pi * 0.5 * T) + 0.4 * np.sin(2 * np.pi * 1.7 * T)
RESPONSE = 2.0 * DRIVE + 0.5 * DRIVE**3 + np.random.default_rng(1).normal(0, 0.01, T.size)


def gain(inputs: Mapping[str, Any], parameters: Mapping[str, Any], dt: float) -> Any:
    return parameters["gain"] * inputs["drive"]


def recording(**more: Any) -> Recording:
    return Recording({"drive": DRIVE}, {"response": RESPONSE}, 0.01, {"drive": "V", "response": "um"}, **more)


@pytest.fixture(scope="module")
def found() -> Diagnosis:
    return diagnose(recording(), Twin(gain, {"gain": 1.5}))


def test_the_import_loads_no_engine_and_starts_no_process() -> None:
    code = (
        "import sys, os; from tools.mismatch import Recording, Twin, diagnose; from tools.bench import open_run;"
        "heavy = ('numba', 'scipy', 'matplotlib', 'pandas', 'xarray', 'joblib', 'multiprocessing', 'rich', 'typer');"
        "print([m for m in heavy if m in sys.modules], len(sys.modules));"
        "print(open(f'/proc/self/task/{os.getpid()}/children').read().split())"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    loaded, children = done.stdout.splitlines()
    names, _, count = loaded.rpartition(" ")
    assert names == "[]"
    assert int(count) < 300
    assert children == "[]"


def test_a_function_is_a_twin(found: Diagnosis) -> None:
    assert found.verdict == "missing_physics"
    assert found.physics
    assert found.report.twin == "gain"
    assert found.report.fit.fitted_rms["response"] < 0.02


def test_results_show_themselves(found: Diagnosis) -> None:
    text = found._repr_html_()
    assert "Missing physics" in text
    assert "<script" not in text
    table = found.to_dataframe()
    base = table[table.effect == "base"].iloc[0]
    assert (base.parameter, base.given) == ("gain", 1.5)
    assert {p.name for p in found.physics} == set(table.effect) - {"base"}
    series = found.series()
    assert series.index.name == "t_s"
    rest = series["response.measured"] - series["response.with_physics"]
    held = float(np.sqrt(np.mean(rest[series["held_out"]] ** 2)))
    assert held == pytest.approx(found.report.fit.fitted_rms["response"], rel=0.05)
    assert found.plot()._repr_png_().startswith(b"\x89PNG")  # type: ignore[attr-defined]
    assert json.loads(json.dumps(found.to_json()))["verdict"] == "missing_physics"
    with pytest.raises(InputError, match="no output 'nope'; there are: response"):
        found.plot("nope")


def test_texts_are_escaped() -> None:
    text = recording(title="<script>alert(1)</script>")._repr_html_()
    assert "<script" not in text
    assert "&lt;script&gt;" in text


def test_a_recording_shows_itself() -> None:
    made = recording(context={"temperature": 20 + 0 * T})
    assert "900 samples, 100 Hz" in made._repr_html_()
    assert list(made.to_dataframe().columns) == ["drive", "response", "temperature"]
    assert made.plot()._repr_png_().startswith(b"\x89PNG")  # type: ignore[attr-defined]
    assert json.loads(json.dumps(made.to_json()))["outputs"]["response"] == RESPONSE.tolist()


def test_columns_of_a_file(tmp_path: Path) -> None:
    path = tmp_path / "data.csv"
    rows = np.column_stack([T, DRIVE, RESPONSE])
    np.savetxt(path, rows, delimiter=",", header="t_s,in_V,out_um", comments="", fmt="%.17g")
    read = Recording.read(path, {"drive": "in_V"}, {"response": "out_um"}, time="t_s", units={"drive": "V"})
    assert read.dt == pytest.approx(0.01)
    assert np.array_equal(np.asarray(read.inputs["drive"]), DRIVE)
    assert Recording.read(path, ["in_V"], "out_um", rate_hz=100).dt == 0.01
    with pytest.raises(InputError, match="neither 'rate_hz' nor 'time'"):
        Recording.read(path, ["in_V"], ["out_um"])
    with pytest.raises(InputError, match="no column 'nope'"):
        Recording.read(path, ["nope"], ["out_um"], rate_hz=100)


def test_a_kind_is_checked_as_a_descriptor_is(tmp_path: Path) -> None:
    np.savez(tmp_path / "data.npz", drive=DRIVE, response=RESPONSE)
    (tmp_path / "recording.toml").write_text(
        'format = 1\ndata = "data.npz"\nrate_hz = 100\n[twin]\nkind = "piezo_stack"\n'
        '[twin.parameters]\ngain_um_per_V = 1.5\n[[channels]]\ncolumn = "drive"\nrole = "input"\nsignal = "command"\n'
        'unit = "mV"\n[[channels]]\ncolumn = "response"\nrole = "output"\nsignal = "displacement"\nunit = "nm"\n'
    )
    by_hand = Recording({"command": DRIVE}, {"displacement": RESPONSE}, 0.01, {"command": "mV", "displacement": "nm"})
    twin = Twin("piezo_stack", {"gain_um_per_V": 1.5})
    a, b = by_hand.with_twin(twin), load(tmp_path)
    assert np.array_equal(a.inputs["command"], b.inputs["command"])
    assert np.array_equal(a.outputs["displacement"], b.outputs["displacement"])
    assert (a.unit, a.twin.parameters, a.dt) == (b.unit, b.twin.parameters, b.dt)
    own = Recording.load(tmp_path)
    assert own.with_twin(None).twin.kind == "piezo_stack"
    assert np.array_equal(own.with_twin(twin).outputs["displacement"], b.outputs["displacement"])


@pytest.mark.parametrize(
    ("act", "message"),
    [
        (lambda: diagnose(recording()), "no twin: give one"),
        (lambda: Recording({"a": DRIVE}, {"b": RESPONSE[1:]}, 0.01), r"differ in length \(a 900, b 899\)"),
        (lambda: Recording({"a": DRIVE}, {"a": RESPONSE}, 0.01), "'a' is given twice"),
        (lambda: Recording({"a": DRIVE[:, None]}, {"b": RESPONSE}, 0.01), r"'a' has shape \(900, 1\)"),
        (lambda: Recording({"a": DRIVE}, {"b": RESPONSE}, 0.0), "dt must be a positive number"),
        (lambda: diagnose(recording(), Twin("nonsense")), "kind 'nonsense' is unknown"),
        (lambda: diagnose(recording(), Twin(gain, {"gain": 1.0}, fixed=["g"])), "fixed parameter 'g'"),
        (lambda: diagnose(recording(), Twin(gain, {})), r"gain\(inputs, parameters, dt\) failed: KeyError"),
        (lambda: diagnose(recording(), Twin(lambda u, p, dt: np.zeros(3))), r"output 'response' has shape \(3,\)"),
        (lambda: diagnose(recording(), Twin(gain, {"gain": 1.0}), held_out=0.9), "share between 0.1 and 0.6"),
    ],
)
def test_bad_input_gets_one_message(act: Any, message: str) -> None:
    with pytest.raises(InputError, match=message):
        act()
