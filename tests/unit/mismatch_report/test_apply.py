"""Corrected twins: written, read, simulated as they were fitted, and diagnosed on new data of the same system."""

import copy
import json
import tomllib
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from hal.trust import allow_name
from sim_devices.physics.catalogue import EFFECTS
from tests.unit.mismatch_report.systems import TWIN, recording
from tools.errors import InputError, RecordingError
from tools.mismatch.apply import corrected_twin, twin_toml
from tools.mismatch.infer import diagnose
from tools.mismatch.recording import TwinText
from tools.mismatch.recording_load import load
from tools.mismatch.simulate import Model
from tools.mismatch.simulate_view import View
from tools.mismatch.twins.feedback import FASTEST
from tools.mismatch.twins.make import make

FEW = [EFFECTS[n] for n in ("dead_zone", "hysteresis", "vibration")]


def written(file: Path, text: str) -> None:
    """As ``micron mismatch apply`` writes it: recordings of other folders may name it."""
    file.write_text(text)
    allow_name(file)


def dead_zone(u: np.ndarray, t: np.ndarray) -> np.ndarray:
    return 0.13 * (u - np.clip(u - 50.0, -3.0, 3.0)) - 1.0


def loop(u: np.ndarray, t: np.ndarray) -> np.ndarray:
    """Two plays in parallel, written here as recursions."""
    out = 0.11 * u - 1.0
    for width, weight in ((4.0, 0.015), (10.0, 0.015)):
        held = u[0]
        for i, v in enumerate(u):
            held = min(max(held, v - width), v + width)
            out[i] += weight * held
    return out


def line(u: np.ndarray, t: np.ndarray) -> np.ndarray:
    """A machine nearby: its phase has nothing to do with when a recording starts."""
    return 0.125 * u - 1.0 + 0.05 * np.sin(2 * np.pi * 13.7 * t + 1e3 * u[0])


def report_of(path: Path) -> dict:
    return json.loads(json.dumps(diagnose(load(path), jobs=1, effects=FEW).to_json()))


@pytest.fixture(scope="module")
def dead(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, dict]:
    path = recording(tmp_path_factory.mktemp("dead") / "first", change=dead_zone)
    return path, report_of(path)


@pytest.mark.parametrize(("change", "name"), [(dead_zone, "dead_zone"), (loop, "hysteresis"), (line, "vibration")])
def test_round_trip(tmp_path: Path, change, name: str):
    """diagnose, apply, diagnose on new data of the same system: nothing is missing any more."""
    first = recording(tmp_path / "first", change=change, samples=2500)
    report = report_of(first)
    assert [p["name"] for p in report["physics"]] == [name]
    written(tmp_path / "twin.toml", corrected_twin(first, report).text)
    again = report_of(
        recording(tmp_path / "second", change=change, seed=2, samples=2500, twin='file = "../twin.toml"\n')
    )
    assert again["verdict"] in ("agrees", "recalibrate")
    as_given = "recalibrated_rms" if name == "vibration" else "base_rms"
    assert again["fit"][as_given]["displacement"] < 1.3 * 0.01
    assert again["twin"] == "piezo_stack"


def test_the_content_may_be_pasted(tmp_path: Path, dead: tuple[Path, dict]):
    path, report = dead
    text = corrected_twin(path, report).text
    pasted = text.split("\n[twin]\n")[1]
    by_paste = load(recording(tmp_path / "a", change=dead_zone, twin=pasted))
    written(tmp_path / "twin.toml", text)
    by_file = load(recording(tmp_path / "b", change=dead_zone, twin='file = "../twin.toml"\n'))
    assert by_paste.twin == by_file.twin
    assert [e["name"] for e in by_file.twin.effects] == ["dead_zone"]


def test_the_written_twin_simulates_what_was_fitted(tmp_path: Path, dead: tuple[Path, dict]):
    path, report = dead
    written(tmp_path / "twin.toml", corrected_twin(path, report).text)
    rec = load(recording(tmp_path / "again", change=dead_zone, twin='file = "../twin.toml"\n'))
    twin = make(rec)
    residual = Model(twin).residual(View.whole(rec), twin.start(rec))["displacement"]
    held = np.concatenate([residual[a:b] for a, b in report["fit"]["held_out_spans"]])
    assert np.sqrt(np.mean(held**2)) == pytest.approx(report["fit"]["fitted_rms"]["displacement"], rel=1e-6)


def test_a_corrected_twin_can_be_corrected_again(tmp_path: Path, dead: tuple[Path, dict]):
    path, report = dead
    written(tmp_path / "twin.toml", corrected_twin(path, report).text)
    moved = recording(
        tmp_path / "moved", change=lambda u, t: 1.1 * dead_zone(u, t), seed=3, twin='file = "../twin.toml"\n'
    )
    second = report_of(moved)
    assert second["verdict"] == "recalibrate"
    table = tomllib.loads(corrected_twin(moved, second).text)["twin"]
    assert [e["name"] for e in table["effects"]] == ["dead_zone"]
    assert table["parameters"]["gain_um_per_V"] == pytest.approx(1.1 * 0.13, rel=0.01)
    assert table["effects"][0]["parameters"]["half_width"] == pytest.approx(3.0, abs=0.15)


AXIS = TwinText("mechanical_axis", {"mass": 2.0, "damping": 5.0, "stiffness": 300.0, "offset_force": 0.0})
FAST = 100.0
STATE_SPACE = TwinText(
    "state_space", {"A": [[0.0, 1.0], [-300.0, -5.0]], "B": [[0.0], [1.0]], "C": [[1.0, 0.0]], "D": [[0.0]]}
)


@pytest.mark.parametrize("kind", ["mechanical_axis", "state_space"])
@pytest.mark.parametrize("stretch", [0.3, 1.0, 1.7])
def test_a_force_stays_the_same_when_the_twin_is_written_and_read(tmp_path: Path, kind: str, stretch: float):
    """The coordinates of a state-space twin change with its poles; the spring inside it and its steps must not."""
    axis = kind == "mechanical_axis"
    rec = load(_dynamic(tmp_path, "position" if axis else "y", "force" if axis else "u", kind))
    twin = make(rec)
    theta = twin.start(rec).copy()
    stiff = 1 if axis else 0  # stiffness per mass, or the natural frequency
    theta[stiff] *= stretch
    output, signal = next(iter(rec.outputs)), next(iter(rec.inputs))
    names = [p.name for p in EFFECTS["cubic_stiffness"].parts({}).weights]
    raw = dict(zip(names, (4000.0 * twin.input_gain(signal, theta), 0.0), strict=True))
    found = {"name": "cubic_stiffness", "site": "feedback", "target": output, "stage": "mechanics"}
    found |= {"outputs": [output], "settings": {FASTEST: [FAST]}, "raw": raw}
    from tools.mismatch.simulate_text import restore

    as_written = {**{k: v for k, v in found.items() if k != "raw"}, "parameters": raw}
    as_fitted = replace(rec, twin=replace(rec.twin, effects=(as_written,)))
    model, start = restore(as_fitted)
    start = start.copy()
    start[: model.n_base] = theta
    want = model.simulate(View.whole(rec), start)[output]
    shifts = [{"name": p.name, "with_effects": float(v)} for p, v in zip(twin.parameters, theta, strict=True)]
    report = {"format": 1, "verdict": "missing_physics", "twin": kind, "physics": [found]}
    report |= {"fit": {"unit": {output: ""}, "base_parameters": shifts}, "corrected_base": twin.to_text(theta)}
    table = tomllib.loads(corrected_twin(rec.path, report).text)["twin"]
    read = replace(rec, twin=TwinText(kind, table["parameters"], tuple(table["effects"])))
    again = make(read)
    got = Model(again).simulate(View.whole(rec), again.start(read))[output]
    assert np.std(want) > 0
    assert got == pytest.approx(want, abs=2e-6 * float(np.std(want)))


def _dynamic(folder: Path, output: str, signal: str, kind: str) -> Path:
    t = np.arange(600) * 0.01
    np.savez(folder / "data.npz", i=20 * np.sin(6 * t) + 15 * np.sin(2.3 * t), o=np.cos(t))
    given = AXIS if kind == "mechanical_axis" else STATE_SPACE
    text = 'format = 1\ndata = "data.npz"\nrate_hz = 100.0\n' + twin_toml(
        {"kind": kind, "parameters": given.parameters, "effects": []}
    )
    for column, role, name, unit in (("i", "input", signal, "N"), ("o", "output", output, "m")):
        text += f'[[channels]]\ncolumn = "{column}"\nrole = "{role}"\nsignal = "{name}"\nunit = "{unit}"\n'
    (folder / "recording.toml").write_text(text)
    return folder / "recording.toml"


def test_events_are_no_part_of_a_twin(dead: tuple[Path, dict]):
    path, report = dead
    event = {**copy.deepcopy(report["physics"][0]), "name": "spikes", "settings": {}, "raw": {}}
    twin = corrected_twin(path, {**report, "physics": [event, *report["physics"]]})
    assert twin.effects == ("dead_zone",)
    assert twin.notes == ("spikes is an event of that recording and no part of the twin",)


def _with(report: dict, *path: object, value: object) -> dict:
    report = copy.deepcopy(report)
    at = report
    for key in path[:-1]:
        at = at[key]
    at[path[-1]] = value
    return report


@pytest.mark.parametrize(
    ("path", "value", "message"),
    [
        (("format",), 7, "format 7, expected 1"),
        (("twin",), "magnetometer", "report is of a magnetometer"),
        (("physics", 0, "name"), "stiction", "'stiction' is not in the vocabulary"),
        (("physics", 0, "raw"), {"half_width": 1.0}, r"parameters centre missing"),
        (("physics", 0, "raw", "half_width"), None, "half_width missing or not finite"),
        (("physics", 0, "site"), "feedback", "cannot sit at 'feedback'"),
        (("physics", 0, "outputs"), ["angle"], "angle"),
        (("physics", 0, "settings"), {"span": "wide"}, "settings must be lists of numbers"),
        (("fit", "unit"), {"angle": "rad"}, r"outputs \(angle\) are not those"),
        (("corrected_base",), {"gain": 1.0}, "'gain' is not a parameter of piezo_stack"),
        (("physics", 0), "creep", "physics 1 has no name"),
        (("physics",), {}, "physics or corrected_base"),
    ],
)
def test_a_bad_report_is_one_clear_message(dead: tuple[Path, dict], path: tuple, value: object, message: str):
    rec, report = dead
    with pytest.raises(InputError, match=message):
        corrected_twin(rec, _with(report, *path, value=value))


def test_missing_parts_are_named(dead: tuple[Path, dict]):
    path, report = dead
    without = {k: v for k, v in report.items() if k not in ("fit", "corrected_base")}
    with pytest.raises(InputError, match="no fit, corrected_base"):
        corrected_twin(path, without)
    bare = {k: v for k, v in report["physics"][0].items() if k != "raw"}
    with pytest.raises(InputError, match=r"\(dead_zone\) has no raw"):
        corrected_twin(path, {**report, "physics": [bare]})


@pytest.mark.parametrize(
    ("twin", "message"),
    [
        ('file = "nowhere.toml"\n', "nowhere.toml does not exist"),
        ('file = "data.npz"\n', "not UTF-8|not valid TOML"),
        ('file = "twin.toml"\nkind = "piezo_stack"\n', "stand alone"),
        (TWIN + '[[twin.effects]]\nname = "stiction"\n', "stiction"),
        (TWIN + '[[twin.effects]]\nname = "creep"\noutputs = ["angle"]\n', r"\['angle'\] are not among displacement"),
        (
            TWIN + '[[twin.effects]]\nname = "temperature_sensitivity"\ntarget = "displacement"\n'
            "[twin.effects.parameters]\nthermal_lag_s = 1.0\nbias_per_K = 1.0\nbias_per_K2 = 0.0\nscale_per_K = 0.0\n",
            "needs temperature",
        ),
    ],
)
def test_a_bad_twin_is_one_clear_message(tmp_path: Path, twin: str, message: str):
    with pytest.raises(RecordingError, match=message):
        make(load(recording(tmp_path, change=dead_zone, samples=100, twin=twin)))


def test_toml_keeps_every_bit_and_quotes_what_needs_it():
    values = {"a": 0.1 + 0.2, "b": -1e-300, "scale_per_x^2": 1.0, "on": True, "list": [[1, 2.5], []], "t": {"1": [0.0]}}
    text = twin_toml({"kind": "x", "parameters": values, "effects": []})
    assert tomllib.loads(text)["twin"]["parameters"] == values
    with pytest.raises(InputError, match="nan"):
        twin_toml({"kind": "x", "parameters": {"a": float("nan")}, "effects": []})
