"""A corrected twin on the emulated bench: the same displacement as the twin that was fitted, and clear errors."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from hal.errors import BenchError
from hal.trust import allow_name
from sim_devices.plant.lab import main
from sim_devices.twin_file import load_twin
from tools.mismatch.recording_load import load
from tools.mismatch.simulate import Model
from tools.mismatch.simulate_view import View
from tools.mismatch.twins.make import make

TWIN = """
[twin]
kind = "piezo_stack"
[twin.parameters]
gain_um_per_V = 0.13
offset_um = 0.4

[[twin.effects]]
name = "first_order_lag"
site = "input"
target = "command"
stage = "amplifier"
outputs = ["displacement"]
[twin.effects.settings]
[twin.effects.parameters]
time_constant_s = 0.004

[[twin.effects]]
name = "creep"
site = "output"
target = "displacement"
stage = "actuator"
outputs = ["displacement"]
[twin.effects.settings]
time_constants_s = [0.02, 0.2, 2.0]
rest_range = [0.0, 100.0]
first = [50.0]
[twin.effects.parameters]
rest = 40.0
c1 = 0.003
c2 = 0.004
c3 = 0.005
"""


def test_the_lab_drives_a_corrected_twin_and_diagnose_reads_the_result(tmp_path: Path) -> None:
    (tmp_path / "twin.toml").write_text(TWIN)
    allow_name(tmp_path / "twin.toml")
    out = tmp_path / "lab"
    given = ["piezo", "--out", str(out), "--seconds", "2", "--rate-hz", "3", "--twin", str(tmp_path / "twin.toml")]
    assert main(given) == 0
    descriptor = (out / "recording.toml").read_text()
    assert 'hold = "zero"' in descriptor
    make(load(out))
    head, tail = descriptor.split("[twin]")
    corrected = head + '[twin]\nfile = "../twin.toml"\n' + tail[tail.index("[[channels]]") :]
    (out / "recording.toml").write_text(corrected)
    rec = load(out)
    model = Model(make(rec))
    residual = model.residual(View.whole(rec), model.start(rec))["displacement"]
    assert residual.std() == pytest.approx(0.07, rel=0.05)
    smooth = np.convolve(residual, np.ones(50) / 50, mode="valid")
    assert np.abs(smooth).max() < 5 * 0.07 / np.sqrt(50)


def test_an_accelerometer_file_gives_every_output_of_its_own(tmp_path: Path) -> None:
    text = """
[twin]
kind = "accelerometer"
[twin.parameters]
bias_V = { voltage_x = 2.5, voltage_y = 2.4 }
scale_V_per_g = { voltage_x = 1.0, voltage_y = 0.9 }
"""
    (tmp_path / "a.toml").write_text(text)
    f = np.linspace(-1.0, 1.0, 60)
    found = load_twin(tmp_path / "a.toml").run(0.01, {"specific_force_x": f, "specific_force_y": -f})
    np.testing.assert_allclose(found["voltage_x"], 2.5 + f)
    np.testing.assert_allclose(found["voltage_y"], 2.4 - 0.9 * f)


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("piezo_stack", "state_space", "no \\[twin\\] that a bench can run"),
        ("first_order_lag", "flux", "1: no effect of the vocabulary"),
        ("c3 = 0.005", "", "2: the parameters of creep are not complete"),
        ("offset_um = 0.4", 'offset_um = "no"', "offset_um must be a finite number"),
        ('stage = "amplifier"', 'stage = "moon"', "stage 'moon' cannot be run here"),
        ("[twin.parameters]", "[twin.parameters", "twin.toml"),
    ],
)
def test_a_bad_file_is_one_clear_message(tmp_path: Path, old: str, new: str, message: str) -> None:
    (tmp_path / "twin.toml").write_text(TWIN.replace(old, new))
    with pytest.raises(BenchError, match=message):
        load_twin(tmp_path / "twin.toml")


def test_a_needed_signal_that_is_missing_is_named(tmp_path: Path) -> None:
    (tmp_path / "twin.toml").write_text(TWIN)
    with pytest.raises(BenchError, match="needs the signal 'command'"):
        load_twin(tmp_path / "twin.toml").run(0.01, {"temperature": np.zeros(60)})
