"""kill -9 and SIGSTOP of the firmware in real time, over a real socket: the DAC must end at neutral all the same."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from firmware_py.guardian.process import REPORT, describe
from firmware_py.run_request import RunRequest
from tests.conftest import copy_of_default_bench

pytestmark = pytest.mark.realtime
ROOT = Path(__file__).parents[2]
NEUTRAL_V = 50.0
RAMP_MS = 16.0
SAMPLE_MS = 1.0
"""Between two rows of the devices' record."""
LEASE_MS = 601
"""Silence after which the guardian of ``Run`` takes the outputs (twice ``stale_ms``, and a margin)."""
TAKING_MS = 1500
"""Time for the guardian's ramp of 16 ms on a machine that is busy with much else."""
RATIO = 3.0
"""How many times the answer of a bare pipe the guardian may take before its ramp begins."""


def wait_for(condition: Callable[[], Any], what: str, limit_s: float = 120.0) -> Any:
    deadline_s = time.monotonic() + limit_s
    while not (found := condition()):
        assert time.monotonic() < deadline_s, f"waited in vain for: {what}"
        time.sleep(0.002)
    return found


LOOPS = [pytest.param(False, id="python"), pytest.param(True, id="compiled", marks=pytest.mark.slow)]


@pytest.fixture
def is_compiled() -> bool:
    return False


@pytest.fixture
def run(tmp_path: Path, is_compiled: bool) -> Iterator[Run]:
    made = Run(tmp_path, is_compiled=is_compiled)
    yield made
    made.end()


class Run:
    """The firmware as ``micron run`` starts it, and what it leaves behind."""

    def __init__(self, folder: Path, safety: str = "", *, is_compiled: bool = False) -> None:
        self.folder = folder
        request = folder / "request.json"
        bench = copy_of_default_bench(folder, f"\n[firmware.safety]\nholds_per_minute = 60\n{safety}")
        # limits of a busy test machine for scans; the guardian's are then twice that for silence, none for death
        wanted = RunRequest(bench, 60.0, pace="realtime", stale_ms=300.0, compiled=is_compiled)
        request.write_text(wanted.to_json(folder))
        self.process = subprocess.Popen(
            [sys.executable, "-m", "firmware_py.app", str(request)],
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            text=True,
            env={**os.environ, "PYTHONPATH": str(ROOT)},
            start_new_session=True,
        )

    def end(self) -> None:
        self.process.kill()
        self.process.communicate()

    def wait_until_moving(self, extra_s: float) -> None:
        assert self.process.stdout is not None
        for line in self.process.stdout:
            status = json.loads(line)
            moving = any(abs(volts - NEUTRAL_V) > 0.5 for volts in status.get("command_V", ()))
            if moving and status["state"] == "running":
                time.sleep(extra_s)
                return
        raise AssertionError(f"the firmware ended before it moved anything: {self.why_ended()}")

    def why_ended(self) -> str:
        """Say why a run is over: a guardian, too, that does not start within its limit on a busy machine ends one."""
        _, errors = self.process.communicate(timeout=120.0)
        path = self.folder / "outcome.json"
        if not path.exists():
            return errors
        outcome = json.loads(path.read_text())
        return f"{outcome['safe_state']['reason']}; holds {outcome['holds']}; {errors}"

    def world(self) -> int:
        """Process id of the emulated world."""
        (world,) = children_of(self.process.pid, b"sim_devices.process")
        return world

    def outcome(self) -> dict[str, Any]:
        """What the run says at its end; it has to leave an outcome file, without a traceback."""
        _, errors = self.process.communicate(timeout=120.0)
        assert "Traceback" not in errors, errors
        assert self.process.returncode == 0, errors
        return json.loads((self.folder / "outcome.json").read_text())

    def report(self) -> dict[str, Any]:
        path = self.folder / REPORT
        wait_for(path.exists, "the guardian's report")
        return json.loads(path.read_text())

    def amplifier(self) -> tuple[np.ndarray, np.ndarray]:
        """Bench time (ns) and voltages at the stacks, from the world that has outlived the firmware."""
        path = wait_for(lambda: next(self.folder.glob("world-*/truth.npz"), None), "the world's truth")
        with np.load(path, allow_pickle=False) as truth:
            return truth["t_ns"], truth["amplifier_V"]


def bare_pipe_ms() -> float:
    """How long this machine takes from the kill of a small process until a reader of its pipe wakes: median of nine."""
    all_ms: list[float] = []
    for _ in range(9):
        reader, writer = os.pipe()
        process = subprocess.Popen(
            [sys.executable, "-S", "-E", "-c", "import time; print(flush=True); time.sleep(600)"],
            stdout=subprocess.PIPE,
            pass_fds=(writer,),
        )
        os.close(writer)
        assert process.stdout is not None
        process.stdout.readline()
        killed_ns = time.monotonic_ns()
        process.kill()
        assert os.read(reader, 1) == b""
        all_ms.append((time.monotonic_ns() - killed_ns) * 1e-6)
        process.communicate()
        os.close(reader)
    return float(np.median(all_ms))


def kill_and_wait_for_neutral(run: Run) -> float:
    """Milliseconds from the kill until the amplifier is at neutral for good, by the devices' own record."""
    killed_ns = time.monotonic_ns()
    run.process.kill()
    run.process.wait()
    report = run.report()
    assert report["why"] == "died"
    assert report["neutral_ns"] > report["taken_ns"] >= report["last_beat_ns"] > 0
    assert "outputs neutral and read back" in describe(report)
    t_ns, volts = run.amplifier()
    away = np.abs(volts - NEUTRAL_V).max(axis=1) > 0.01
    assert away[t_ns < killed_ns].any()  # something was moving
    assert (~away[t_ns > report["neutral_ns"] + 2_000_000]).sum() > 100
    return float(t_ns[away].max() - killed_ns) * 1e-6


@pytest.mark.parametrize("is_compiled", LOOPS)
def test_a_killed_firmware_leaves_neutral_outputs_as_soon_as_a_pipe_could_tell(
    tmp_path: Path, is_compiled: bool
) -> None:
    """The answer waits neither for a heartbeat to be missed nor for the memory of the dead to be freed. A machine that
    is busy with something else just then may be slow once; the cause that is looked for made every answer slow."""
    answers: list[tuple[float, float]] = []
    for attempt in range(3):
        folder = tmp_path / str(attempt)
        folder.mkdir()
        run = Run(folder, is_compiled=is_compiled)
        try:
            run.wait_until_moving(0.137 * attempt)
            limit_ms = RAMP_MS + SAMPLE_MS + RATIO * bare_pipe_ms()
            answers.append((kill_and_wait_for_neutral(run), limit_ms))
        finally:
            run.end()
        if answers[-1][0] <= limit_ms:
            return
    raise AssertionError(f"neutral so many ms after the kill, and the limit of the moment: {answers}")


@pytest.mark.parametrize("is_compiled", LOOPS)
def test_a_firmware_that_stands_still_is_taken_over_and_holds_when_it_wakes(run: Run, tmp_path: Path) -> None:
    run.wait_until_moving(0.1)
    os.kill(run.process.pid, signal.SIGSTOP)
    time.sleep(0.9)
    os.kill(run.process.pid, signal.SIGCONT)
    assert run.process.stdout is not None
    for line in run.process.stdout:
        status = json.loads(line)
        if status.get("state") in ("hold", "safe ramp", "safe") or status.get("holds"):
            break
    run.process.send_signal(signal.SIGINT)
    run.process.stdout.read()
    assert run.process.wait(60.0) == 0
    outcome = json.loads((tmp_path / "outcome.json").read_text())
    assert outcome["safe_state"]["reached"]
    assert outcome["holds"][0]["class"] == "host"
    assert "no command for a while (guardian)" in outcome["noticed"]


@pytest.mark.parametrize("is_compiled", [True])
def test_stops_of_a_millisecond_to_seconds_are_the_hosts_and_one_that_outlasts_the_lease_is_spent_at_neutral(
    run: Run,
) -> None:
    run.wait_until_moving(0.1)
    stops: list[tuple[int, int]] = []
    for ms in (1, 5, 20, 3000):
        began_ns = time.monotonic_ns()
        os.kill(run.process.pid, signal.SIGSTOP)
        time.sleep(ms * 1e-3)
        stops.append((began_ns, time.monotonic_ns()))
        os.kill(run.process.pid, signal.SIGCONT)
        time.sleep(0.2)
    run.process.send_signal(signal.SIGINT)
    outcome = run.outcome()
    assert outcome["loop"]["ticks"] > 0
    assert outcome["safe_state"]["reached"], outcome["safe_state"]
    assert {hold["class"] for hold in outcome["holds"]} <= {"host"}, outcome["holds"]
    with np.load(run.folder / "truth.npz", allow_pickle=False) as truth:
        t_ns, volts = truth["t_ns"], truth["amplifier_V"]
    away = np.abs(volts - NEUTRAL_V).max(axis=1) > 0.01
    assert away[t_ns < stops[0][0]].any()  # something was moving
    assert not away[-1]
    began_ns, ended_ns = stops[-1]
    within = (t_ns > began_ns + (LEASE_MS + TAKING_MS) * 1_000_000) & (t_ns < ended_ns)
    assert within.sum() > 100
    assert not away[within].any()


def children_of(pid: int, module: bytes) -> list[int]:
    children = [int(child) for child in Path(f"/proc/{pid}/task/{pid}/children").read_text().split()]
    return [child for child in children if module in Path(f"/proc/{child}/cmdline").read_bytes()]


def guardians_of(run: Run) -> list[int]:
    return children_of(run.process.pid, b"guardian.process")


@pytest.mark.parametrize("is_compiled", LOOPS)
@pytest.mark.parametrize("blow", [signal.SIGKILL, pytest.param(signal.SIGSTOP, marks=pytest.mark.slow)])
def test_a_guardian_that_is_lost_is_replaced_and_the_new_one_guards(run: Run, blow: signal.Signals) -> None:
    """The run holds and resumes; then the firmware is killed as well, and the new guardian takes the outputs."""
    run.wait_until_moving(0.1)
    (first,) = guardians_of(run)
    os.kill(first, blow)
    assert run.process.stdout is not None
    for line in run.process.stdout:
        status = json.loads(line)
        if status.get("state") == "running" and status.get("holds"):
            break
    run.wait_until_moving(0.1)
    (second,) = guardians_of(run)
    assert second != first
    kill_and_wait_for_neutral(run)


@pytest.mark.slow
def test_the_result_tells_of_the_lost_guardian(run: Run, tmp_path: Path) -> None:
    run.wait_until_moving(0.1)
    os.kill(guardians_of(run)[0], signal.SIGKILL)
    assert run.process.stdout is not None
    for line in run.process.stdout:
        status = json.loads(line)
        if status.get("state") == "running" and status.get("holds"):
            break
    run.process.send_signal(signal.SIGINT)
    run.process.stdout.read()
    assert run.process.wait(60.0) == 0
    outcome = json.loads((tmp_path / "outcome.json").read_text())
    assert outcome["guardian"] == {"watching": True, "replaced": 1}, outcome["safe_state"]["reason"]
    held = [hold for hold in outcome["holds"] if hold["finding"] == "guardian_lost"]
    assert [hold["resumed"] for hold in held] == [True]
    assert outcome["safe_state"]["reached"]


@pytest.mark.parametrize("is_compiled", LOOPS)
def test_a_bus_that_hangs_for_more_than_half_a_second_is_opened_anew_and_brought_to_neutral(run: Run) -> None:
    """All devices stand still, then go on. Who of the two brings the outputs to neutral, and that neither is ended for
    it, is tested in virtual time (``test_hanging_bus.py``): here the world makes up for lost time on a busy machine."""
    run.wait_until_moving(0.1)
    world = run.world()
    os.kill(world, signal.SIGSTOP)
    time.sleep(1.2)
    os.kill(world, signal.SIGCONT)
    time.sleep(1.0)
    run.process.send_signal(signal.SIGINT)
    outcome = run.outcome()
    safe = outcome["safe_state"]
    assert safe["reached"], safe["reason"]
    assert outcome["holds"] or not safe["normal"]
    with np.load(run.folder / "truth.npz", allow_pickle=False) as truth:
        np.testing.assert_allclose(truth["amplifier_V"][-1], NEUTRAL_V, atol=0.01)


@pytest.mark.parametrize("is_compiled", LOOPS)
def test_a_signal_to_all_processes_of_a_run_ends_it_at_neutral(run: Run) -> None:
    """The emulated world once ended by it as well, before the outputs were at neutral."""
    run.wait_until_moving(0.0)
    os.kill(run.world(), signal.SIGTERM)
    os.killpg(run.process.pid, signal.SIGTERM)
    safe = run.outcome()["safe_state"]
    assert safe["reached"], safe["reason"]
    assert safe["finding"] == "stopped"
    _, volts = run.amplifier()
    np.testing.assert_allclose(volts[-1], NEUTRAL_V, atol=0.01)


@pytest.mark.slow  # 16 s: it waits until nobody can answer any more
def test_a_world_that_is_killed_before_an_interrupt_leaves_an_outcome_that_says_so(run: Run) -> None:
    """Interrupts end the tries of ten seconds, and whatever part of its end the run is in, it leaves an outcome."""
    run.wait_until_moving(0.1)
    os.kill(run.world(), signal.SIGKILL)
    time.sleep(0.3)
    for _ in range(3):
        run.process.send_signal(signal.SIGINT)
        time.sleep(0.3)
    outcome = run.outcome()
    safe = outcome["safe_state"]
    assert not safe["reached"]
    assert "neutral NOT confirmed" in safe["reason"]
    assert "switch the amplifier off" in safe["reason"]


@pytest.mark.parametrize("is_compiled", LOOPS)
def test_a_firmware_that_dies_while_its_bus_hangs_leaves_a_guardian_and_a_world_until_both_are_done(run: Run) -> None:
    run.wait_until_moving(0.1)
    world = run.world()
    os.kill(world, signal.SIGSTOP)
    run.process.kill()
    run.process.wait()
    time.sleep(2.5)  # longer than the guardian once tried, and than the world once waited
    os.kill(world, signal.SIGCONT)
    report = run.report()
    assert report["neutral_ns"], describe(report)
    _, volts = run.amplifier()
    np.testing.assert_allclose(volts[-1], NEUTRAL_V, atol=0.01)
