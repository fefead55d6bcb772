"""The JSON of a report against the contract, spelled out by hand; and that the spelling notices departures."""

import copy
import json

import numpy as np
import pytest

from sim_devices.physics.catalogue import EFFECTS
from tests.unit.mismatch_report.canned import all_verdicts
from tests.unit.mismatch_report.contract_check import NAMES, faults
from tests.unit.mismatch_report.systems import recording
from tools.mismatch.infer import diagnose
from tools.mismatch.recording_load import load


@pytest.mark.parametrize("verdict", ["agrees", "recalibrate", "missing_physics", "unexplained"])
def test_every_verdict_is_the_contract_s(verdict: str):
    report = json.loads(json.dumps(all_verdicts()[verdict].to_json(), allow_nan=False))
    assert faults(report) == []
    assert report["verdict"] == verdict


def test_the_contract_s_own_names_are_the_vocabulary():
    assert sorted(EFFECTS) == sorted(NAMES)


@pytest.mark.parametrize(
    ("path", "value"),
    [
        (("verdict",), "fine"),
        (("format",), 2),
        (("summary",), ""),
        (("location", "stage"), "cable"),
        (("location", "windows"), [{"start_s": 2.0, "stop_s": 1.0}]),
        (("location", "depends_on"), [{"signal": "command", "feature": "rate", "strength": 1.4}]),
        (("physics", 0, "name"), "stiction"),
        (("physics", 0, "confidence"), 97),
        (("physics", 0, "parameters", "fraction_per_decade", "ci95"), [0.1, 0.2]),
        (("physics", 0, "source"), ""),
        (("physics",), []),
        (("alternatives", 0, "why_not"), ""),
        (("equivalent", 0, "names"), ["creep"]),
        (("detection_limit",), {}),
        (("detection_limit", "displacement", "creep"), None),
        (("fit", "held_out"), False),
        (("fit", "fitted_rms"), {"displacement": None}),
        (("checks", "false_alarm_p_value"), 2.0),
        (("checks", "residual_white_after"), "yes"),
    ],
)
def test_departures_are_noticed(path: tuple, value: object):
    report = copy.deepcopy(all_verdicts()["missing_physics"].to_json())
    at = report
    for key in path[:-1]:
        at = at[key]
    at[path[-1]] = value
    assert faults(report)


def made(tmp_path, change, **kwargs):
    """What the engine says of the stack of ``systems``, with two effects to choose from: quick."""
    path = recording(tmp_path / "rec", change=change, **kwargs)
    few = [EFFECTS["dead_zone"], EFFECTS["temperature_sensitivity"]]
    return json.loads(json.dumps(diagnose(load(path), jobs=1, effects=few).to_json(), allow_nan=False))


@pytest.mark.parametrize(
    ("verdict", "change"),
    [
        ("agrees", lambda u, t: 0.125 * u - 1.0),
        ("recalibrate", lambda u, t: 0.14 * u - 1.4),
        ("missing_physics", lambda u, t: 0.125 * (u - np.clip(u - 50.0, -3.0, 3.0)) - 1.0),
        ("unexplained", lambda u, t: 0.125 * u - 1.0 + 0.3 * np.sin(2 * np.pi * 7.3 * t) * np.sign(u - 50.0)),
    ],
)
def test_what_the_engine_makes_is_the_contract_s(tmp_path, verdict: str, change):
    report = made(tmp_path, change)
    assert faults(report) == []
    assert report["verdict"] == verdict
    floor = report["fit"]["noise_floor_rms"]["displacement"]
    assert floor == pytest.approx(0.01, rel=0.15)
