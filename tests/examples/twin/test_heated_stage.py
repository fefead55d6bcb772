"""Its parameters are found again from data of another rule (Euler's); what it lacks (a stop at the top) is named."""

import shutil
from pathlib import Path

import numpy as np
import pytest

from sim_devices.physics.catalogue import EFFECTS
from tools.errors import RecordingError
from tools.mismatch.infer import diagnose
from tools.mismatch.recording_load import load

HERE = Path(__file__).parent

DT_S, SHARE = 0.1, 0.1 / 4.0  # Euler: of the way in one step


def write_data(folder, top_um: float = np.inf):
    rng = np.random.default_rng(0)
    power = np.repeat(rng.uniform(0, 10, 24), 50)
    warm = np.zeros_like(power)
    for i in range(1, power.size):
        warm[i] = warm[i - 1] + SHARE * (power[i - 1] - warm[i - 1])
    position = np.minimum(2.1 * warm, top_um) + rng.normal(0, 0.01, power.size)
    np.savez(f"{folder}/data.npz", p=power, z=position)


def recorded(folder, top_um: float = np.inf):
    write_data(folder, top_um)
    shutil.copy(HERE / "recording.toml", folder)
    few = [EFFECTS["saturation"], EFFECTS["dead_zone"]]
    return diagnose(load(folder), jobs=1, effects=few)


def test_its_parameters_are_found(tmp_path):
    report = recorded(tmp_path)
    assert report.verdict == "recalibrate"
    assert report.corrected_base["um_per_W"] == pytest.approx(2.1, rel=0.01)
    assert report.corrected_base["time_constant_s"] == pytest.approx(-DT_S / np.log(1 - SHARE), rel=0.01)


def test_what_it_lacks_is_named(tmp_path):
    report = recorded(tmp_path, top_um=14.0)
    assert [p.name for p in report.physics] == ["saturation"]
    assert report.physics[0].parameters["upper_limit"].value == pytest.approx(14.0, rel=0.01)


def test_an_output_that_it_does_not_give_is_an_error(tmp_path):
    text = (HERE / "recording.toml").read_text().replace('"position"', '"height"')
    (tmp_path / "recording.toml").write_text(text)
    np.savez(tmp_path / "data.npz", p=np.arange(400) % 7, z=np.arange(400) % 5)
    with pytest.raises(RecordingError, match="returned no output 'height'"):
        diagnose(load(tmp_path), jobs=1, effects=[])
