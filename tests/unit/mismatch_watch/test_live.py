"""A twin beside a running instrument: rows of the frame in pieces, an alarm with place and time, gaps, bad input."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from firmware_py.frame import LAYOUT, TIME
from hal.bench import BenchFile, load_bench
from sim_devices.config import emulation_config
from sim_devices.plant.instrument import Instrument
from sim_devices.plant.recorded_hand import make_hand
from tests.conftest import DEFAULT_BENCH
from tests.recording_text import channel
from tools.errors import InputError
from tools.mismatch.export.run import free_run
from tools.mismatch.recording_load import load
from tools.mismatch.watch.frame import LiveTwin, World, open_twin
from tools.mismatch.watch.last import write_recording
from tools.mismatch.watch.live import LiveWatch, Settings, Watching, lines

NAMES = LAYOUT.scalar_names()
VOLTS = LAYOUT["volts"]
START_S = 0.5
SECONDS = 40
BENCH_TWIN = 'format = 1\n[twin]\nkind = "instrument"\n[twin.parameters]\nbench = "bench.toml"\nhand = "bench"\n'
STACK_TWIN = (
    """format = 1
[twin]
kind = "piezo_stack"
[twin.parameters]
gain_um_per_V = 0.125
offset_um = 0.0
"""
    + channel("command_1", "input", "command", "V")
    + channel("stroke_1", "output", "displacement", "m")
)


@pytest.fixture(scope="module")
def bench() -> BenchFile:
    return load_bench(DEFAULT_BENCH)


@pytest.fixture(scope="module")
def rows(bench: BenchFile) -> np.ndarray:
    """Frames of an emulated instrument whose volts alone are filled in."""
    config = emulation_config(bench.description.model_dump())
    instrument = Instrument(config, config.seed, make_hand(config.hand, config.seed, None, None), unit=config.unit)
    out = np.zeros((SECONDS * 1000, LAYOUT.size))
    out[:, TIME] = 0.001 * np.arange(1, len(out) + 1)
    for k, t_s in enumerate(out[:, TIME].tolist()):
        instrument.advance_to(round((t_s + START_S) * 1e9))
        out[k, VOLTS] = instrument.analog_V
    return out


@pytest.fixture
def twin(tmp_path: Path, bench: BenchFile) -> LiveTwin:
    (tmp_path / "bench.toml").write_text(bench.text)
    (tmp_path / "twin.toml").write_text(BENCH_TWIN)
    return open_twin(tmp_path / "twin.toml", bench, NAMES, World())


def watch(twin: LiveTwin, rows: np.ndarray, reference_s: float = 20.0, piece: int = 97) -> Watching:
    beside = LiveWatch(twin, Settings(Path("twin.toml"), reference_s, 0.01), is_patient=True)
    beside.begin_at(START_S)
    for k in range(0, len(rows), piece):
        beside.push(rows[k : k + piece])
    return beside.close()


def test_a_good_twin_stays_and_costs_less_than_a_twentieth_of_a_processor(twin: LiveTwin, rows: np.ndarray):
    found = watch(twin, rows)
    assert found.phase == "watching"
    assert not found.alarms
    assert set(found.reference_rms) == {f"volts_{i}" for i in range(6)}
    assert found.cpu_share < 0.05
    assert "reality does not leave the twin" in lines(found)[-1]


def test_a_bias_of_one_sensor_is_placed_and_dated(twin: LiveTwin, rows: np.ndarray):
    changed = rows.copy()
    changed[30_000:, VOLTS.start + 3] += 0.001
    found = watch(twin, changed)
    assert {a.channel for a in found.alarms} == {"volts_3"}
    first = found.alarms[0]
    assert first.figure == "level"
    assert first.rises
    assert 30.0 <= first.t_s < 34.0
    assert first.onset_s == pytest.approx(30.0, abs=1.0)
    assert "volts_3: leaves the twin at about" in " ".join(lines(found))


def test_missing_rows_are_a_gap_and_no_alarm(twin: LiveTwin, rows: np.ndarray):
    lost = np.delete(rows, np.r_[8000:8500, 25_000:27_000], axis=0)
    found = watch(twin, lost)
    assert (found.gaps, found.phase, found.alarms) == (2, "watching", ())


def test_times_behind_a_gap_are_those_of_the_run(twin: LiveTwin, rows: np.ndarray):
    changed = rows.copy()
    changed[33_000:, VOLTS.start + 1] += 0.002
    found = watch(twin, np.delete(changed, np.r_[25_000:28_000], axis=0))
    assert found.alarms[0].channel == "volts_1"
    assert found.alarms[0].onset_s == pytest.approx(33.0, abs=1.0)


def test_a_reference_longer_than_the_run_tests_nothing(twin: LiveTwin, rows: np.ndarray):
    found = watch(twin, rows[:5000])
    assert found.phase == "reference"
    assert "nothing was tested" in lines(found)[0]


def test_a_twin_of_columns_of_the_frame_runs_in_windows(tmp_path: Path, bench: BenchFile):
    (tmp_path / "recording.toml").write_text(STACK_TWIN)
    rng = np.random.default_rng(3)
    table = np.zeros((30_000, LAYOUT.size))
    table[:, TIME] = 0.001 * np.arange(len(table))
    volts = 50.0 + 20.0 * np.sin(2 * np.pi * 1.3 * table[:, TIME])
    table[:, LAYOUT.start("command")] = volts
    table[:, LAYOUT.start("stroke")] = 1e-6 * (0.125 * volts + 0.02 * rng.standard_normal(len(table)))
    table[24_000:, LAYOUT.start("stroke")] += 5e-9
    found = watch(open_twin(tmp_path, bench, NAMES, World()), table, 15.0)
    assert found.phase == "watching", found.why
    assert found.unit == {"displacement": "um"}
    assert found.reference_rms["displacement"] == pytest.approx(0.02, rel=0.05)
    assert found.alarms[0].onset_s == pytest.approx(24.0, abs=1.0)
    assert found.cpu_share < 0.05


def test_the_last_rows_are_a_recording_of_the_same_twin(tmp_path: Path, twin: LiveTwin, rows: np.ndarray):
    twin.begin_at(START_S)
    columns = {c: rows[-10_000:, NAMES.index(c)] for c in twin.template.column.values()}
    write_recording(tmp_path / "last", tmp_path / "twin.toml", twin, rows[-10_000:, TIME], columns)
    recording = load(tmp_path / "last")
    assert recording.twin.parameters["start_s"] == pytest.approx(START_S + SECONDS - 9.999)
    away = recording.outputs["volts_1"] - free_run(recording)["volts_1"]
    assert float(np.std(away)) < 0.1 * float(np.std(recording.outputs["volts_1"]))
    with pytest.raises(InputError, match=r"only 0\.1 s without a gap"):
        write_recording(tmp_path / "x", tmp_path / "twin.toml", twin, rows[:100, TIME], columns)


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ('format = 1\n[twin]\nkind = "piezo_stack"\n', "does not say which columns of the frame a piezo_stack reads"),
        (STACK_TWIN.replace("stroke_1", "stroke_9"), "no column 'stroke_9' in the frame"),
        (STACK_TWIN.replace('"m"', '"degC"'), "degC"),
        (BENCH_TWIN.replace("bench.toml", "none.toml"), "none.toml"),
        ("no toml", "not valid TOML"),
    ],
)
def test_a_twin_that_does_not_fit_is_one_message(tmp_path: Path, bench: BenchFile, text: str, said: str):
    (tmp_path / "twin.toml").write_text(text)
    with pytest.raises((InputError, ValueError), match=said):
        open_twin(tmp_path / "twin.toml", bench, NAMES, World())


def test_programs_do_not_run_beside_an_instrument(tmp_path: Path, bench: BenchFile):
    with pytest.raises(InputError, match=r"only a \.toml twin"):
        open_twin(tmp_path / "twin.fmu", bench, NAMES, World())


def test_the_hand_of_a_real_bench_is_nobodys(tmp_path: Path, bench: BenchFile):
    (tmp_path / "bench.toml").write_text(bench.text)
    (tmp_path / "twin.toml").write_text(BENCH_TWIN)
    text = bench.text
    for uri in ("daq0", "i2c0", "i2c1", "can0"):
        text = text.replace(f"sim://{uri}", "socketcan://can0" if uri == "can0" else f"serial:///dev/{uri}")
    (tmp_path / "real.toml").write_text(text.replace("serial:///dev/i2c", "linux-i2c://"))
    with pytest.raises(InputError, match="a real one"):
        open_twin(tmp_path / "twin.toml", load_bench(tmp_path / "real.toml"), NAMES, World())
