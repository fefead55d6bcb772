"""The diagnostic commands on the emulated bench in virtual time: what they find, and their exit codes."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from typer.testing import Result

from firmware_py.scheduler.histogram import DurationHistogram
from tests.command import micron
from tools.diagnose.latency import octaves
from tools.diagnose.ramp import staircase
from tools.diagnose.scope import BLOCKS, sparkline


def run(*arguments: str) -> Result:
    return micron(*arguments)


def result_of(path: Path) -> dict:
    return json.loads(path.read_text())


def test_scan_finds_the_declared_devices_and_the_button(tmp_path: Path):
    out = tmp_path / "scan.json"
    assert run("scan", "--virtual", "--seconds", "2", "--json", str(out)).exit_code == 0
    found = result_of(out)
    assert {(a["address"], a["declared"], a["answered"]) for a in found["i2c"]} == {
        (0x0C, "piezo", True),
        (0x48, "mag_adc", True),
        (0x49, "monitor_adc", True),
    }
    assert [(c["can_id"], c["name"]) for c in found["can"]] == [(0x080, "STOP_BUTTON")]
    assert found["can"][0]["rate_hz"] == pytest.approx(2.0, abs=0.5)
    assert found["missing"] == []


def test_scan_has_no_table_for_a_kind_of_bus_that_the_bench_lacks():
    done = run("scan", "--virtual", "--seconds", "0", "--bench", "imus")
    assert done.exit_code == 0
    assert "I2C" in done.output
    assert "CAN" not in done.output


def test_scan_asks_before_it_writes():
    refused = micron("scan", "--virtual", "--probe", "write", input="n\n")
    assert refused.exit_code == 2
    assert "Write to every address" in refused.output
    alone = micron("scan", "--virtual", "--probe", "write")
    assert alone.exit_code == 2
    assert "micron: you did not agree, so nothing was done; --yes agrees beforehand" in alone.output


def test_scope_sees_the_inputs(tmp_path: Path):
    out = tmp_path / "scope.json"
    done = run("scope", "--virtual", "--seconds", "0.3", "--json", str(out))
    assert done.exit_code == 0
    inputs = result_of(out)["inputs"]
    assert len(inputs) == 8
    assert inputs["input 6"]["mean_V"] == pytest.approx(2.5, abs=0.1)  # half the supply
    assert result_of(out)["lost"] == 0


def test_a_sparkline_shows_a_single_sample():
    values = np.zeros(10_000)
    values[4321] = -1.0
    line = sparkline(values, 50)
    assert len(line) == 50
    assert line[4321 * 50 // 10_000] == BLOCKS[0]
    assert set(line) == {BLOCKS[0], BLOCKS[-1]}
    assert sparkline(np.ones(10), 50) == BLOCKS[3] * 10


def test_ramp_reads_back_what_it_wrote(tmp_path: Path):
    out = tmp_path / "ramp.json"
    done = run("ramp", "--virtual", "--arm", "--channel", "2", "--steps", "5", "--dwell-s", "0.005", "--json", str(out))
    assert done.exit_code == 0
    found = result_of(out)
    assert {row["output"] for row in found["rows"]} == {2}
    assert max(row["wanted_V"] for row in found["rows"]) == pytest.approx(100.0, abs=0.01)
    assert abs(found["worst_error_V"]) <= 100.0 / 65536


def test_ramp_moves_nothing_without_arm():
    refused = run("ramp", "--virtual")
    assert refused.exit_code == 2
    assert run("ramp", "--virtual", "--arm", "--channel", "4").exit_code == 2


def test_a_staircase_starts_and_ends_at_neutral_and_touches_both_limits():
    stairs = staircase(0.0, 100.0, 50.0, 5)
    assert stairs == [50.0, 75.0, 100.0, 100.0, 75.0, 50.0, 25.0, 0.0, 25.0, 50.0, 50.0]


def test_can_dump_decodes(tmp_path: Path):
    out = tmp_path / "can.json"
    done = run("dump", "--virtual", "--seconds", "5", "--count", "3", "--json", str(out))
    assert done.exit_code == 0
    frames = result_of(out)["frames"]
    assert [f["message"] for f in frames] == ["STOP_BUTTON"] * 3
    assert [f["signals"]["sequence"] for f in frames] == [0.0, 1.0, 2.0]


@pytest.fixture(scope="module")
def transcript(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("golden") / "bench"
    assert run("capture", "--virtual", "--seconds", "0.05", "--out", str(folder)).exit_code == 0
    return folder


def test_a_transcript_agrees_with_driver_and_emulator(transcript: Path, tmp_path: Path):
    out = tmp_path / "diff.json"
    assert run("capture", "--diff", str(transcript), "--json", str(out)).exit_code == 0
    assert result_of(out)["protocol"] == 0
    assert result_of(out)["compared"] > 50
    assert run("capture", "--virtual", "--out", str(transcript)).exit_code == 2


@pytest.mark.parametrize(
    ("bus", "was", "now", "side"),
    [
        ("daq0", b"info 1".hex(), b"info 9".hex(), "driver"),  # the driver asks something else than was asked
        ("daq0", b"info 1 4108".hex(), b"info 1 2108".hex(), "emulator"),  # the real device says something else
        ("i2c0", "w18 r0000", "w18 r00", "driver"),
    ],
)
def test_a_difference_is_found_on_the_side_where_it_is(
    transcript: Path, tmp_path: Path, bus: str, was: str, now: str, side: str
):
    changed = tmp_path / "changed"
    changed.mkdir()
    for file in transcript.iterdir():
        text = file.read_text()
        if file.stem == bus:
            assert was in text or (side == "driver" and bus == "i2c0")
            text = text.replace(was, now, 1) if was in text else text.replace(" r", " w00 r", 1)
        (changed / file.name).write_text(text)
    out = tmp_path / "diff.json"
    assert run("capture", "--diff", str(changed), "--json", str(out)).exit_code == 1
    assert (bus, side) in {(d["bus"], d["side"]) for d in result_of(out)["differences"] if d["kind"] == "protocol"}


def test_what_is_no_transcript_is_bad_input(tmp_path: Path):
    done = run("capture", "--diff", str(tmp_path))
    assert done.exit_code == 2
    assert "no transcript (No such file or directory); make one" in " ".join(done.output.split())


def test_without_a_bench_page_there_is_no_log():
    assert run("log", "--url", "http://127.0.0.1:1", "--seconds", "1").exit_code == 4
    assert run("log", "--url", "nonsense").exit_code == 2


def test_octaves_count_everything_once():
    histogram = DurationHistogram()
    for value in (500, 1000, 1500, 3000, 70_000, 5_000_000):
        histogram.add(value, 0)
    table = octaves(histogram)
    assert sum(n for _, n in table) == 6
    assert [bound for bound, _ in table] == sorted(bound for bound, _ in table)
    assert table[0] == (0.512, 1)


def test_a_declared_device_that_is_silent_is_exit_4(monkeypatch: pytest.MonkeyPatch):
    from sim_devices.transports.i2c_line import I2cLine

    attach = I2cLine.attach
    monkeypatch.setattr(
        I2cLine, "attach", lambda self, address, face: attach(self, address ^ (2 * (address == 0x48)), face)
    )
    done = run("scan", "--virtual", "--seconds", "0")
    assert done.exit_code == 4
    assert "mag_adc" in done.output
