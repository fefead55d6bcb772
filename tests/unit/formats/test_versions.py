"""Files of format version 1 open with the values they were written with; a later version is named in the refusal.

``tests/golden/v1`` is never written again: a version that cannot read it is one that broke somebody's recordings.
"""

from __future__ import annotations

import struct
from pathlib import Path

import numpy as np
import pytest

from firmware_py.control.plan import load_plan
from firmware_py.recording import format as fmt
from firmware_py.recording.errors import RecordingError
from firmware_py.recording.reader import Recording
from firmware_py.sensing.config import SensingConfig
from firmware_py.sensing.noise_file import noise_table
from hal.bench import load_bench
from hal.errors import BenchError
from tests.conftest import DEFAULT_BENCH
from tools.mismatch import recording_load as twins
from tools.research.tremor.cascade_file import load_network

GOLDEN = Path(__file__).parents[2] / "golden" / "v1"


def test_a_recording_of_version_1_has_every_value():
    recording = Recording(GOLDEN / "recording.mcap")
    assert recording.names == ("tick", "t", "volts_0", "command_1", "status")
    k = np.arange(250)
    np.testing.assert_array_equal(recording.column("tick"), k)
    np.testing.assert_array_equal(recording.column("volts_0"), np.sin(k) * 2.5)
    np.testing.assert_array_equal(recording.column("command_1"), 50.0 + k / 7.0)
    assert [e.content for e in recording.events] == [{"event": "mark", "t_ns": 120_000_000}]
    assert recording.metadata["stages"] == {"gain": 1.5}
    assert not recording.health.lost


def bench_with(tmp_path: Path, calibration: str) -> Path:
    path = tmp_path / "bench.toml"
    (tmp_path / "calibration.toml").write_text(calibration)
    text = DEFAULT_BENCH.read_text()
    start = text.index("calibration = [")
    path.write_text(text[:start] + 'calibration = ["calibration.toml"]' + text[text.index("]", start) + 1 :])
    return path


def test_a_calibration_of_version_1_arrives_in_the_stages(tmp_path: Path):
    path = bench_with(tmp_path, (GOLDEN / "calibration.toml").read_text())
    configs = load_plan(load_bench(path)).stages
    assert configs.tremor.loop_delay_s == 0.0017
    assert configs.actuation.low_V == 5.0


def test_a_calibration_of_a_later_version_is_named(tmp_path: Path):
    text = (GOLDEN / "calibration.toml").read_text().replace("format = 1", "format = 3")
    with pytest.raises(BenchError, match=r"calibration\.toml: a calibration of format 3, written by a later version"):
        load_plan(load_bench(bench_with(tmp_path, text)))


def test_a_calibration_without_a_version_is_refused(tmp_path: Path):
    text = (GOLDEN / "calibration.toml").read_text().replace("format = 1", "")
    with pytest.raises(BenchError, match="format = 1 is missing"):
        load_plan(load_bench(bench_with(tmp_path, text)))


def test_noise_of_version_1_arrives_and_a_later_one_is_named(tmp_path: Path):
    table = noise_table(GOLDEN / "noise.json", SensingConfig())
    np.testing.assert_allclose(table["axis_drift_m_s2"], 1e-3, rtol=1e-12)  # 1e-4 sqrt(100 s)
    later = tmp_path / "noise.json"
    later.write_text((GOLDEN / "noise.json").read_text().replace('"format": 1', '"format": 2'))
    with pytest.raises(BenchError, match=r"noise\.json: noise file needs format = 1"):
        noise_table(later, SensingConfig())


def test_weights_of_version_1_open_with_their_values_and_a_later_one_is_named(tmp_path: Path):
    network = load_network(GOLDEN / "cascade.json")
    assert (network.window, network.spacing, network.scale, network.centred) == (3, 2, 5e-5, True)
    assert network.kinds == ("sigmoid", "bessel")
    np.testing.assert_array_equal(network.hidden[1], [0.1, 0.2, 0.3, 0.4, -0.5, 0.0])
    np.testing.assert_array_equal(network.output, [0.0, 1.0, -1.0, 0.5, 0.25, 0.125])
    later = tmp_path / "cascade.json"
    later.write_text((GOLDEN / "cascade.json").read_text().replace('"format": 1', '"format": 2'))
    with pytest.raises(BenchError, match=r"cascade\.json: \[format\] "):
        load_network(later)


def test_a_twin_of_version_1_opens_and_a_later_one_is_named(tmp_path: Path):
    recording = twins.load(GOLDEN / "twin")
    assert recording.twin.kind == "state_space"
    assert recording.twin.parameters["A"] == [[-10.0]]
    for name in ("recording.toml", "data.csv"):
        text = (GOLDEN / "twin" / name).read_text()
        (tmp_path / name).write_text(text.replace("format = 1", "format = 2"))
    with pytest.raises(twins.RecordingError, match="format must be 1, got 2"):
        twins.load(tmp_path)


def test_a_block_of_a_later_version_is_named():
    columns = fmt.check_columns([("tick", "1")])
    crc = fmt.layout_crc(columns)
    block = bytearray(fmt.encode_block(0, np.zeros((3, 1)), crc))
    struct.pack_into("<4s", block, 0, b"MTB2")
    with pytest.raises(RecordingError, match="blocks of format 2: a later version wrote them"):
        fmt.decode_block(bytes(block), crc, 1)


def test_a_bench_of_a_later_version_is_refused_with_its_key(tmp_path: Path):
    path = tmp_path / "bench.toml"
    path.write_text(DEFAULT_BENCH.read_text().replace("format = 1", "format = 2", 1))
    with pytest.raises(BenchError, match=r"\[format\]"):
        load_bench(path)
