"""It is a bench, the instrument works on it in virtual time, and a slip in it is named before anything is opened."""

import shutil
from pathlib import Path

import pytest

import benches
from drivers.specs import check_devices
from firmware_py.app import run_in_process
from firmware_py.run_request import RunRequest
from hal.bench import load_bench
from hal.errors import BenchError


@pytest.fixture
def bench(tmp_path):
    """The bench file with the calibration of the emulated instrument beside it."""
    shutil.copytree(Path(benches.__file__).with_name("calibration"), tmp_path / "calibration")
    return Path(shutil.copy(Path(__file__).with_name("bench.toml"), tmp_path))


def test_the_instrument_runs_on_it(bench):
    outcome, truth = run_in_process(RunRequest(bench, 2.0, pace="virtual"))
    assert set(outcome["devices"]) == {"daq", "piezo"}
    assert outcome["samples"]["lost"] == 0
    assert outcome["safe_state"]["normal"]
    assert abs(truth["stroke_m"]).max() > 1e-6


@pytest.mark.parametrize(
    ("right", "wrong", "message"),
    [
        ("z = 1", "z = 2", r"\[device\.acc2\] channel 2 of 'daq' is taken by 'acc1'"),
        ("rate_hz = 1000", "rate_hz = 500", r"the scans drive the tick of 1000 Hz; make them equal"),
        ('bus = "i2c0"', 'bus = "i2c1"', r"\[device\.piezo\.bus\] no bus named 'i2c1'"),
        ("address = 0x0C", "adress = 0x0C", r"adress\] unknown key; check the spelling"),
    ],
)
def test_a_slip_is_named(bench, right, wrong, message):
    bench.write_text(bench.read_text().replace(right, wrong))
    with pytest.raises(BenchError, match=message):
        check_devices(load_bench(bench).description, "bench.toml")
