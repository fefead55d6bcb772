"""An endoscope bench from file to outcome: wiring, loop, filter, control, faults, in virtual time."""

from __future__ import annotations

import json
import os
import socket
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from typer.testing import CliRunner

import benches
from firmware_py.app import run_in_process
from firmware_py.endoscope.frame import LAYOUT
from firmware_py.endoscope.wiring import is_endoscope
from firmware_py.live.memory import LiveMemory
from firmware_py.recording.reader import Recording
from firmware_py.replay import replay_recording
from firmware_py.run_request import RunRequest
from hal.bench import OpenBench, load_bench
from hal.errors import BenchError
from tools.cli.main import app
from tools.reports.endoscope_report import complete_run, inclination_errors_deg

TEXT = """
format = 1
name = "endoscope"
[clock]
tick_hz = 1000
[emulation]
provider = "sim_devices.register:provider"
seed = 3
[emulation.endoscope]
scenario = "{scenario}"
attitude_deg = [10.0, -5.0, 0.0]
poses = {poses}
presses = {presses}
[emulation.imu.imu]
errors = 0.0
noise = 0.0
[emulation.imu.card]
errors = 0.0
noise = 0.0
[bus.i2c0]
kind = "i2c"
uri = "sim://i2c0"
speed_hz = 400_000
[bus.card0]
kind = "serial"
uri = "sim://card0"
baud = 115_200
[device.imu]
driver = "mpu6050"
bus = "i2c0"
address = 0x68
rate_hz = 100
gyro_range_dps = 500.0
[device.card]
driver = "motion_card"
bus = "card0"
rate_hz = 100
[firmware]
{firmware}
"""
# activation at 0.2 s; from 0.8 s roll goes from 10 to 22 degrees within 0.4 s
MOVE = {"scenario": "poses", "poses": "[[0.8, 22.0, -5.0, 0.0, 0.4]]", "presses": "[[0.2, 0.1]]", "firmware": ""}


def bench(folder: Path, **words: str) -> Path:
    path = folder / "bench.toml"
    path.write_text(TEXT.format(**{**MOVE, **words}))
    return path


def run(path: Path, seconds: float = 2.0, **more: Any) -> tuple[dict[str, Any], dict[str, Any]]:
    outcome, truth = run_in_process(RunRequest(path, seconds, pace="virtual"), **more)
    assert truth is not None
    return outcome, truth


def test_which_benches_are_endoscopes() -> None:
    folder = Path(benches.__file__).parent
    names = ("micron", "micron-can", "micron-e727", "endoscope")
    found = [name for name in names if is_endoscope(load_bench(folder / f"{name}.toml").description)]
    assert found == ["endoscope"]


def test_turning_the_card_moves_the_view(tmp_path: Path) -> None:
    outcome, truth = run(bench(tmp_path))
    # 12 degrees at 8 px per degree, response time 0.25 s long over
    expected = 320.0 + 8.0 * 12.0 * (1.0 - (0.25 / 0.26) ** 80)
    assert outcome["view"]["status"] == 1
    assert outcome["view"]["x"] == pytest.approx(expected, abs=4.0)
    assert outcome["view"]["y"] == pytest.approx(240.0, abs=2.0)
    card, imu = outcome["sensors"]["card"], outcome["sensors"]["imu"]
    assert card["received"] == pytest.approx(200, abs=2)
    assert imu["received"] == pytest.approx(200, abs=2)
    assert card["lost"] == imu["lost"] == card["bad_frames"] == 0
    # the wire tells only the change of status: 20 ms from it are two samples
    assert 2 <= card["masked"] <= 3
    safe = outcome["safe_state"]
    assert (safe["reached"], safe["reason"], safe["normal"]) == (True, "run finished", True)
    result = complete_run(outcome, truth)
    assert result["attitude"]["imu"]["inclination_rms_deg"] < 0.2
    # the click shakes the card: 20 ms after the press, not filtered on the wire, bend the attitude a little
    assert result["attitude"]["card"]["inclination_rms_deg"] < 1.0
    json.dumps(result)


def test_the_same_run_gives_the_same_numbers(tmp_path: Path) -> None:
    path = bench(tmp_path)
    first, second = (run(path, 1.0)[0] for _ in range(2))
    for outcome in (first, second):
        for task in outcome["tasks"].values():
            task.pop("cpu", None)
    first.pop("tasks")
    second.pop("tasks")
    assert first == second


def at(opened: OpenBench, t_s: float, fault: str, target: str) -> None:
    """Do ``fault`` ``t_s`` from now."""
    opened.clock.at(opened.clock.now_ns() + round(t_s * 1e9), lambda _: opened.world.inject(fault, target))  # type: ignore[attr-defined, union-attr]


def test_a_silent_card_holds_the_view_and_ends_the_run_if_it_stays_silent(tmp_path: Path) -> None:
    outcome, _ = run(bench(tmp_path), 5.0, on_open=lambda opened: at(opened, 1.0, "freeze", "card"))
    safe = outcome["safe_state"]
    assert not safe["normal"]
    assert safe["finding"] == "hold_too_long"
    assert "card: no sample for 500 ms" in safe["reason"]
    # half a second of silence, then hold_limit_ms
    assert outcome["ran_s"] == pytest.approx(1.0 + 0.5 + 3.0, abs=0.1)


def test_a_card_that_speaks_again_ends_the_hold_and_the_view_goes_on_from_where_it_stood(tmp_path: Path) -> None:
    def pause(opened: OpenBench) -> None:
        at(opened, 0.6, "freeze", "card")
        at(opened, 1.6, "thaw", "card")

    file = tmp_path / "run.mcap"
    path = bench(tmp_path)
    outcome, _ = run_in_process(RunRequest(path, 2.5, pace="virtual", record=file), on_open=pause)
    (hold,) = outcome["holds"]
    assert hold["resumed"]
    assert hold["finding"] == "samples_missing"
    assert outcome["safe_state"]["normal"]
    recording = Recording(file)
    t, view, held = (recording.column(name) for name in ("t", "view_x", "held"))
    assert set(np.unique(held)) == {0.0, 1.0}
    # the card turned by 12 degrees, 96 px, while it was silent: the view neither jumps nor catches up
    assert np.max(np.abs(np.diff(view))) < 5.0
    assert np.ptp(view[t > 1.6]) < 5.0
    assert replay_recording(recording).identical


def test_a_bus_that_fails_for_a_moment_is_waited_out(tmp_path: Path) -> None:
    path = bench(tmp_path, firmware='steered_by = "imu"')
    request = RunRequest(path, 1.5, pace="virtual", inject=("i2c0:nack=1,from_s=0.5,for_s=0.2",))
    outcome, _ = run_in_process(request)
    assert [hold["finding"] for hold in outcome["holds"]] == ["sensor_transfer"]
    assert outcome["holds"][0]["resumed"]
    assert outcome["safe_state"]["normal"]
    assert outcome["sensors"]["imu"]["failed"] > 5
    assert outcome["injected"]["i2c0"]["nacked"] > 5


def test_it_records_and_replays_bit_for_bit(tmp_path: Path) -> None:
    file = tmp_path / "run.mcap"
    outcome, _ = run_in_process(RunRequest(bench(tmp_path), 1.0, pace="virtual", record=file))
    assert outcome["recorder"] == {"ticks": outcome["sensors"]["card"]["received"], "dropped": 0, "problem": ""}
    recording = Recording(file)
    assert recording.column("view_x")[-1] == pytest.approx(outcome["view"]["x"], abs=1.0)
    assert set(np.unique(recording.column("status"))) == {0.0, 1.0}
    assert recording.health.lost == 0
    report = replay_recording(recording)
    assert report.identical
    assert report.rows == outcome["recorder"]["ticks"]


def test_a_page_sees_the_frames_and_may_end_the_run(tmp_path: Path) -> None:
    memory = LiveMemory.create(LAYOUT.size, 2048)
    page, ours = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)

    def ask(opened: OpenBench) -> None:
        order = json.dumps({"order": "safe"}).encode()
        opened.clock.at(opened.clock.now_ns() + 500_000_000, lambda _: page.send(order))  # type: ignore[attr-defined]

    request = RunRequest(bench(tmp_path), 2.0, pace="virtual", live_fds=(os.dup(memory.fd), ours.detach()))
    told: list[dict[str, Any]] = []
    try:
        outcome, _ = run_in_process(request, told.append, on_open=ask)
        rows = memory.read(0).values
        assert len(rows) == outcome["sensors"]["card"]["received"]
        assert rows[-1][LAYOUT["view_x"]] == pytest.approx(outcome["view"]["x"])
        assert outcome["safe_state"]["finding"] == "stopped_on_page"
        assert outcome["ran_s"] == pytest.approx(0.5, abs=0.05)
        assert [t["event"] for t in told if "event" in t] == ["devices", "safe state"]
        assert next(t["histograms"] for t in told if "histograms" in t)[0] == "arrival to view"
    finally:
        memory.close()
        page.close()


def test_bad_tables_are_refused_before_a_device_is_touched(tmp_path: Path) -> None:
    with pytest.raises(BenchError, match=r"firmware.*fusion"):
        run(bench(tmp_path, firmware='fusion = { method = "kalman" }'))
    with pytest.raises(BenchError, match=r"steered_by.*imu, card"):
        run(bench(tmp_path, firmware='steered_by = "ring"'))


def test_inclination_error_of_a_known_tilt() -> None:
    half = np.radians(3.0) / 2
    truth = {"t_ns": np.array([0, 100]), "quaternion": np.array([[1.0, 0, 0, 0], [1.0, 0, 0, 0]])}
    rows = np.array([[50.0, np.cos(half), np.sin(half), 0.0, 0.0], [200.0, 1.0, 0.0, 0.0, 0.0]])
    angles = inclination_errors_deg(rows, truth)
    assert angles[0] == pytest.approx(3.0)
    assert np.isnan(angles[1])


def test_options_of_the_other_instrument_are_refused(tmp_path: Path) -> None:
    arguments = ["run", "--bench", str(bench(tmp_path)), "--virtual", "--hand", "hand.csv"]
    found = CliRunner().invoke(app, arguments)
    assert found.exit_code == 2
    assert "--hand" in found.output


def test_the_run_command_reports(tmp_path: Path) -> None:
    out = tmp_path / "run.json"
    arguments = ["run", "--bench", str(bench(tmp_path)), "--virtual", "--seconds", "1", "--json", str(out)]
    assert CliRunner().invoke(app, arguments).exit_code == 0
    result = json.loads(out.read_text())
    assert result["instrument"] == "endoscope"
    assert "attitudes" not in result
    assert result["attitude"]["imu"]["inclination_rms_deg"] < 0.2
