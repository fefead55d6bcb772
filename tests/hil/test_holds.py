"""Every recoverable finding three times in one run, resumed each time: judged by what reached the amplifier.

Emulated bench, virtual time, exact. The demands at the amplifier are the devices' truth; the firmware's word is only
compared with it.
"""

from __future__ import annotations

import signal
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from firmware_py.app import run_in_process
from firmware_py.recording.reader import Recording
from firmware_py.replay import replay_recording
from firmware_py.run.findings import Finding
from firmware_py.run.safety import SafetyLimits
from firmware_py.run_request import RunRequest
from hal.bench import OpenBench, Port
from hal.contracts import Clock
from hal.errors import BenchError
from hal.middleware.faults import FaultPlan
from hal.types import I2cOp, I2cRead
from tests.conftest import DEFAULT_BENCH
from tools.research.faults.fault import InWorld, Kill, OnBus, OnHost
from tools.research.faults.points import POINTS, write_bench
from tools.research.faults.trial import FarBench

FIRST_S = 1.5
NEUTRAL_V = 50.0
CODE_V = 100.0 / 65536
RAMP_MS = 21.0
LIMITS = SafetyLimits()
LOOSE = """
[firmware.plausibility]
jump_V = 5.0
rail_V = [-1.0, 10.0]
stuck_ticks = 10000
pair_m_s2 = 50.0
"""
"""Without the checks of single readings, which know of these before the slower ones do."""


@dataclass(frozen=True)
class Scene:
    """``strikes`` begin at one instant. ``known_ms``: by when the outputs must be on their way to neutral."""

    finding: Finding
    strikes: tuple[Any, ...]
    known_ms: float
    every_s: float = 0.7
    bench: str = ""


def stall(ms: float, *others: Any) -> tuple[Any, ...]:
    """The host stands still last: what else happens has begun by then."""
    return (*others, OnHost(ms))


SCENES = (
    Scene(Finding.SCANS_MISSING, (OnBus("daq0", {"silent_after_s": 0.0, "silent_for_s": 0.02}),), 6.0),
    Scene(
        Finding.HOST_OVERSLEPT, stall(30.0, OnBus("daq0", {"silent_after_s": 0.0, "silent_for_s": 0.05})), 37.0
    ),
    Scene(Finding.HOST_LATE, stall(110.0), 112.0),
    Scene(Finding.DAQ_OVERFLOW, (InWorld("overflow", "daq"),), 2.0),
    Scene(
        Finding.DAQ_OVERFLOW_BY_HOST, stall(300.0), 303.0, 1.2,
        "\n[firmware.safety]\nguardian = false\nstalled_ms = 1000.0\n",
    ),
    Scene(Finding.DAQ_TRANSFER, (OnBus("daq0", {"loss": 0.3, "for_s": 0.004, "seed": 5}),), 25.0),
    Scene(Finding.SATURATED, (InWorld("sensor_short", "1", "sensor_ok", 0.1),), 70.0, 1.2, LOOSE),
    Scene(Finding.SUPPLY_OUTSIDE, (InWorld("supply=0.85", "", "supply=1", 0.2),), 260.0, 1.2, LOOSE),
    Scene(
        Finding.TEMPERATURE_OUTSIDE, (InWorld("sensor_gain", "7", "sensor_ok", 0.3),), 300.0, 2.0,
        LOOSE + "\n[firmware.safety]\ntemperature_C = [0.0, 35.0]\n",
    ),
    Scene(Finding.MAGNETOMETER_SILENT, (InWorld("nack", "mag_adc", "ack", 0.18),), 165.0, 0.8),
    Scene(Finding.MAGNETOMETER_HANGS, (InWorld("freeze", "mag_adc", "thaw", 0.25),), 200.0, 0.9),
    Scene(Finding.OUTPUT_TRANSFER, (InWorld("nack", "piezo", "ack", 0.002),), 2.0),
    Scene(Finding.OUTPUT_TAKEN, ("stall in read-back",), 90.0),
    Scene(Finding.LEASE_LOST, stall(60.0), 61.0),
    Scene(Finding.GUARDIAN_LOST, (Kill("guardian"),), 12.0, 1.2),
    Scene(Finding.MONITOR_DEAF, (InWorld("nack", "monitor_adc", "ack", 0.13),), 120.0, 0.8),
    Scene(Finding.BUTTON_BUS, ("bus-off for 30 ms",), 20.0),
    Scene(Finding.BUTTON_SILENT, (InWorld("silence", "can0", "speak", 1.52),), 1600.0, 2.8),
)  # fmt: skip


class StallInReadBack:
    """I2cBus on which the host stands still within a read-back of the outputs, when it is told to."""

    def __init__(self, bus: Any, clock: Any) -> None:
        self._bus, self._clock, self.due = bus, clock, False

    def transfer(self, address: int, ops: Sequence[I2cOp]) -> bytes:
        if self.due and isinstance(ops[-1], I2cRead) and ops[-1].n == 8:
            self.due = False
            self._clock.burn_ns(80_000_000)
        return self._bus.transfer(address, ops)

    def __getattr__(self, name: str) -> Any:
        return getattr(self._bus, name)


def run_scene(
    scene: Scene,
    times: int,
    folder: Path,
    *,
    more: str = "",
    record: Path | None = None,
    after_s: float = 0.0,
    on_open: Callable[[OpenBench], None] = lambda _: None,
) -> tuple[dict[str, Any], list[tuple[int, int, float]], list[int]]:
    """Outcome, demands at the amplifier (t_ns, channel, V), instants of the strikes."""  # fmt: skip
    bench = write_bench(DEFAULT_BENCH, POINTS[1], folder)
    bench.write_text(bench.read_text() + scene.bench + more)
    far = FarBench()
    stalls: list[StallInReadBack] = []
    struck: list[int] = []

    def wrap(bus: str, port: Port, clock: Clock) -> Port:
        made: Any = far.wrap(bus, port, clock)
        if bus == "i2c0":
            made = StallInReadBack(made, clock)
            stalls.append(made)
        return made

    def strike(t_ns: int) -> None:
        struck.append(t_ns)
        for how in scene.strikes:
            if how == "stall in read-back":
                stalls[0].due = True
            elif how == "bus-off for 30 ms":
                can: Any = far.ports["can0"][0]
                can.arm(FaultPlan(bus_off_after_s=0.0))
                far.clock.at(t_ns + 30_000_000, lambda _, can=can: can.arm(FaultPlan()))
            else:
                far.strike(how, seed=5)

    def open_hook(opened: OpenBench) -> None:
        far.attach(opened)
        on_open(opened)
        for k in range(times):
            far.clock.at(round((FIRST_S + k * scene.every_s) * 1e9), strike)

    seconds = FIRST_S - 0.4 + times * scene.every_s + after_s
    request = RunRequest(bench, seconds, pace="virtual", record=record)
    outcome, _ = run_in_process(request, on_open=open_hook, wrap=wrap)
    return outcome, far.demands, struck


class Path3:
    """The three outputs over time, made of the demands: volts hold until the next demand of their channel."""

    def __init__(self, demands: list[tuple[int, int, float]]) -> None:
        self.t_ns = np.array([t_ns for t_ns, _, _ in demands])
        self.volts = np.full((len(demands), 3), NEUTRAL_V)
        for row, (_, channel, volts) in enumerate(demands):
            self.volts[row:, channel] = volts
        self.away_V = np.abs(self.volts - NEUTRAL_V).max(axis=1)

    def rest_after(self, t_ns: int, shortest_ms: float) -> tuple[int, int]:
        """Row of the first demand after ``t_ns`` with which all outputs are at neutral for ``shortest_ms``, and row of
        the first one that moves them again (the number of rows when none does)."""
        away = self.away_V > CODE_V
        for row in np.flatnonzero((self.t_ns > t_ns) & ~away):
            moved = np.flatnonzero(away[row:])
            stop = row + int(moved[0]) if moved.size else len(away)
            if stop == len(away) or (self.t_ns[stop] - self.t_ns[row]) * 1e-6 >= shortest_ms:
                return int(row), stop
        raise AssertionError(f"no rest at neutral after {t_ns * 1e-9:.3f} s")


def assert_held_and_resumed(path: Path3, struck_ns: int, known_ms: float) -> int:
    """From the truth alone: the ramp, neutral and nothing else, then on without a step. Row of the first motion."""
    row, stop = path.rest_after(struck_ns, LIMITS.hold_ms - 1.0)
    assert (path.t_ns[row] - struck_ns) * 1e-6 <= known_ms + RAMP_MS
    assert stop < len(path.t_ns), "the outputs never moved again"
    ramp = path.away_V[(path.t_ns > path.t_ns[row] - 13_000_000) & (path.t_ns <= path.t_ns[row])]
    assert np.all(np.diff(ramp) <= CODE_V), "not straight to neutral"
    assert np.all(path.away_V[row:stop] <= CODE_V)
    soon = (path.t_ns >= path.t_ns[stop]) & (path.t_ns < path.t_ns[stop] + 20_000_000)
    assert path.away_V[stop] < 0.1, "a step out of neutral"
    assert np.abs(np.diff(path.volts[soon], axis=0)).max() < 0.6  # V per ms; the ramp itself may do 3
    return stop


def test_there_is_a_scene_for_every_recoverable_finding():
    recoverable = {finding for finding in Finding if finding.value.recoverable}
    recoverable.remove(Finding.SUPERVISION_SILENT)  # of the compiled loop alone: tests/unit/compiled/test_both_loops.py
    # of the other instrument: tests/unit/endoscope/test_endoscope_bench.py
    recoverable -= {Finding.SAMPLES_MISSING, Finding.SENSOR_TRANSFER}
    assert {scene.finding for scene in SCENES} == recoverable
    assert len(SCENES) == len(recoverable)


@pytest.mark.timeout(120)
@pytest.mark.parametrize("scene", SCENES, ids=lambda scene: scene.finding.name.lower())
def test_three_times_in_one_run_and_resumed_each_time(scene: Scene, tmp_path: Path):
    outcome, demands, struck = run_scene(scene, 3, tmp_path)
    assert len(struck) == 3
    path = Path3(demands)
    for struck_ns in struck:
        assert_held_and_resumed(path, struck_ns, scene.known_ms)
    # the firmware's word
    holds = outcome["holds"]
    assert [hold["finding"] for hold in holds] == [scene.finding.name.lower()] * 3
    assert [hold["class"] for hold in holds] == [scene.finding.value.cause.value] * 3
    assert all(hold["resumed"] for hold in holds)
    for hold, struck_ns in zip(holds, struck, strict=True):
        assert 0.0 <= (hold["t_ns"] - struck_ns) * 1e-6 <= scene.known_ms
        assert hold["length_s"] >= LIMITS.hold_ms * 1e-3
        assert hold["t_s"] == pytest.approx(hold["t_ns"] * 1e-9, abs=0.2)
    assert outcome["safe_state"]["normal"], outcome["safe_state"]["reason"]
    if outcome["guardian"] is not None:
        assert outcome["guardian"] == {"watching": True, "replaced": 3 * (scene.finding is Finding.GUARDIAN_LOST)}


REFUSED = next(scene for scene in SCENES if scene.finding is Finding.OUTPUT_TRANSFER)
SILENT = next(scene for scene in SCENES if scene.finding is Finding.SCANS_MISSING)


def test_the_fourth_within_a_minute_latches(tmp_path: Path):
    outcome, demands, struck = run_scene(REFUSED, 4, tmp_path)
    safe = outcome["safe_state"]
    assert safe["reason"].startswith("hold 4 within a minute, more than [firmware.safety] holds_per_minute = 3: piezo")
    assert safe["reached"]
    assert not safe["normal"]
    assert len(outcome["holds"]) == 3
    path = Path3(demands)
    row, stop = path.rest_after(struck[3], 0.0)
    assert (path.t_ns[row] - struck[3]) * 1e-6 <= REFUSED.known_ms + RAMP_MS
    assert stop == len(path.t_ns), "it moved after a latched finding"


def test_without_holds_every_finding_ends_the_run(tmp_path: Path):
    outcome, _, _ = run_scene(REFUSED, 1, tmp_path, more="\n[firmware.safety]\nholds_per_minute = 0\n")
    assert outcome["safe_state"]["reason"].startswith("piezo: ")
    assert outcome["holds"] == []


@pytest.mark.parametrize("hangs_s", [0.6, 3.0])
def test_an_amplifier_that_comes_back_is_brought_to_neutral_and_the_report_says_when(hangs_s: float, tmp_path: Path):
    scene = Scene(Finding.OUTPUT_TRANSFER, (InWorld("nack", "piezo", "ack", hangs_s),), 2.0)
    outcome, demands, struck = run_scene(scene, 1, tmp_path, after_s=hangs_s)
    safe = outcome["safe_state"]
    assert (safe["finding"], safe["reached"], safe["normal"]) == ("neutral_not_reached", True, False)
    assert 1e3 * hangs_s - 5.0 < safe["late_ms"] < 1e3 * hangs_s + 100.0
    assert f"neutral was confirmed only after {safe['late_ms']:.0f} ms" in safe["reason"]
    assert "NOT confirmed" not in safe["reason"]
    path = Path3(demands)
    row, stop = path.rest_after(struck[0] + round(hangs_s * 1e9), 0.0)
    assert stop == len(demands)
    assert path.t_ns[row] <= safe["reached_ns"]


def test_an_amplifier_that_does_not_come_back_is_tried_for_ten_seconds_and_said_loudly(tmp_path: Path):
    scene = Scene(Finding.OUTPUT_TRANSFER, (InWorld("nack", "piezo"),), 2.0)
    ended: list[int] = []

    def note_end(opened: OpenBench) -> None:
        ended.append(0)
        opened.closers.append(lambda: ended.append(opened.clock.now_ns()))

    outcome, _, struck = run_scene(scene, 1, tmp_path, on_open=note_end)
    safe = outcome["safe_state"]
    assert not safe["reached"]
    assert safe["late_ms"] is None
    assert "neutral NOT confirmed" in safe["reason"]
    assert safe["reason"].endswith("switch the amplifier off")
    assert 9.9e9 < ended[-1] - struck[0] < 10.5e9


def test_a_hold_that_does_not_pass_latches_after_its_limit(tmp_path: Path):
    scene = Scene(Finding.SCANS_MISSING, (OnBus("daq0", {"silent_after_s": 0.0}),), 6.0)
    outcome, demands, struck = run_scene(scene, 1, tmp_path, more="\n[firmware.safety]\nhold_limit_ms = 400.0\n")
    safe = outcome["safe_state"]
    assert "no new scan for 5 ms" in safe["reason"]
    assert "has not passed within 400 ms" in safe["reason"]
    assert not safe["normal"]
    (hold,) = outcome["holds"]
    assert not hold["resumed"]
    assert hold["length_s"] == pytest.approx(0.4, abs=0.01)
    _, stop = Path3(demands).rest_after(struck[0], 0.0)
    assert stop == len(demands)


def test_a_run_waits_for_the_end_of_a_hold_and_then_ends_well(tmp_path: Path):
    """The strike comes 20 ms before the planned end."""
    outcome, demands, struck = run_scene(REFUSED, 1, tmp_path, after_s=-REFUSED.every_s - 0.15)
    planned_ns = outcome["armed_ns"] + round(outcome["seconds"] * 1e9)
    assert 0 < planned_ns - struck[0] < 150_000_000
    assert outcome["safe_state"]["normal"]
    assert outcome["safe_ns"] - outcome["holds"][0]["t_ns"] >= LIMITS.hold_ms * 1e6
    _, stop = Path3(demands).rest_after(struck[0], 0.0)
    assert stop == len(demands)


def test_a_guardian_that_cannot_be_replaced_ends_the_run(tmp_path: Path):
    scene = next(scene for scene in SCENES if scene.finding is Finding.GUARDIAN_LOST)
    outcome, demands, struck = run_scene(
        Scene(scene.finding, (*scene.strikes, Kill("new guardians")), 12.0), 1, tmp_path
    )
    safe = outcome["safe_state"]
    assert (safe["finding"], safe["class"], safe["reached"], safe["normal"]) == ("guardian_failed", "host", True, False)
    assert safe["reason"].startswith(
        "the guardian of the outputs was lost, and the guardian of the outputs did not start"
    )
    assert outcome["guardian"] == {"watching": False, "replaced": 0}
    assert [hold["resumed"] for hold in outcome["holds"]] == [False]
    _, stop = Path3(demands).rest_after(struck[0], 0.0)
    assert stop == len(demands), "it moved without a guardian"


def test_a_guardian_that_dies_in_the_self_test_is_replaced_before_anything_moves(tmp_path: Path):
    def kill_early(opened: OpenBench) -> None:
        clock: Any = opened.clock
        clock.at(round(0.4e9), lambda _: opened.processes.dead.add("guardian"))

    outcome, demands, _ = run_scene(REFUSED, 0, tmp_path, after_s=0.5, on_open=kill_early)
    assert outcome["guardian"] == {"watching": True, "replaced": 1}
    assert "the guardian is lost" in outcome["noticed"]
    assert outcome["holds"] == []
    assert outcome["safe_state"]["normal"], outcome["safe_state"]["reason"]
    assert outcome["armed_ns"] > 0.9e9
    assert demands


def test_a_latched_finding_in_a_hold_ends_the_run(tmp_path: Path):
    scene = Scene(Finding.SCANS_MISSING, (*SILENT.strikes, InWorld("press", "")), 6.0)
    outcome, demands, struck = run_scene(scene, 1, tmp_path)
    assert outcome["safe_state"]["reason"] == "stop button pressed"
    assert outcome["safe_state"]["reached"]
    _, stop = Path3(demands).rest_after(struck[0], 0.0)
    assert stop == len(demands)


@pytest.mark.parametrize("asks", [False, True])
def test_with_an_operator_a_hold_lasts_until_somebody_asks(asks: bool, tmp_path: Path):
    """SIGUSR1, as ``micron run`` sends it for a key; one that comes before the cause has passed does nothing."""

    def schedule(opened: OpenBench) -> None:
        clock: Any = opened.clock
        early_ns, late_ns = round((FIRST_S + 0.1) * 1e9), round((FIRST_S + 0.45) * 1e9)
        clock.at(early_ns, lambda _: signal.raise_signal(signal.SIGUSR1))
        if asks:
            clock.at(late_ns, lambda _: signal.raise_signal(signal.SIGUSR1))

    more = '\n[firmware.safety]\nrearm = "operator"\n'
    outcome, demands, struck = run_scene(REFUSED, 1, tmp_path, more=more, on_open=schedule)
    (hold,) = outcome["holds"]
    assert hold["resumed"] is asks
    path = Path3(demands)
    _, stop = path.rest_after(struck[0], 0.0)
    if asks:
        assert (path.t_ns[stop] - struck[0]) * 1e-6 == pytest.approx(450.0, abs=5.0)
    else:
        assert stop == len(demands)
        assert outcome["safe_state"]["normal"], "its cause has passed; only nobody was there"


def test_an_unknown_way_to_rearm_is_refused_in_one_message(tmp_path: Path):
    with pytest.raises(BenchError, match=r"firmware.*safety.*rearm.*automatic.*operator"):
        run_scene(REFUSED, 0, tmp_path, more='\n[firmware.safety]\nrearm = "sometimes"\n')


@pytest.mark.parametrize("scene", [REFUSED, SILENT], ids=["all scans", "lost scans"])
def test_a_recording_with_holds_replays_bit_for_bit_and_tells_of_them(scene: Scene, tmp_path: Path):
    file = tmp_path / "run.mcap"
    outcome, _, _ = run_scene(scene, 2, tmp_path, record=file)
    recording = Recording(file)
    report = replay_recording(recording)
    assert report.identical, report.as_dict()
    assert report.left_out == 0
    assert report.rows == outcome["samples"]["received"]
    told = [event.content for event in recording.events if str(event.content["event"]).startswith("hold")]
    assert [event["event"] for event in told] == ["hold begins", "hold ends"] * 2
    assert told[0]["finding"] == scene.finding.name.lower()
    assert told[0]["class"] == "link"
    assert told[1]["length_s"] == pytest.approx(outcome["holds"][0]["length_s"], abs=1e-3)
