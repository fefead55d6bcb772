"""Compiled runs from the page: the Setup view's switch, what refuses one, and a whole run with a recording."""

from __future__ import annotations

import asyncio
import json
import os
import signal
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from firmware_py.recording.reader import Recording
from hal.errors import BenchError
from tests.bench.conftest import Server, bench_server, go
from tests.bench.still import Still
from tests.conftest import DEFAULT_BENCH
from tools.bench.app import read_choice
from tools.bench.firmware import Choice
from tools.bench.session import Session
from tools.errors import InputError

pytestmark = pytest.mark.timeout(600)
SERIAL, EIGHT = (DEFAULT_BENCH.with_name(f"micron-{name}.toml") for name in ("e727", "eight"))
WHY = f"{EIGHT}: --compiled cannot run: device.acc1, device.acc2, device.acc3, device.acc4: 8 accelerometer axes"
SAID = "document.querySelector('.setup .note[role=status]').textContent"
SWITCH = ".setup label:has-text('compiled') input"


# -- the choice of a run -------------------------------------------------------------------------------------


@pytest.mark.parametrize("pace", [None, "realtime"])
def test_a_compiled_run_is_on_the_wall_clock_and_one_in_python_keeps_its_pace(pace: Any) -> None:
    choice = Choice(DEFAULT_BENCH, pace=pace, compiled=True)
    assert (choice.runs_compiled, choice.run_pace) == (True, "realtime")
    assert Choice(DEFAULT_BENCH, pace=pace).run_pace == pace
    sensing = Choice(DEFAULT_BENCH, pace=pace, compiled=True, sense_only=True)
    assert (sensing.runs_compiled, sensing.run_pace) == (False, pace)


def test_the_choice_stays_with_its_bench(tmp_path: Path) -> None:
    session = Session(Choice(DEFAULT_BENCH), tmp_path)

    def next_choice(**table: Any) -> Choice:
        session.choice = read_choice(session, table)
        return session.choice

    assert not next_choice().compiled
    assert next_choice(compiled=True).runs_compiled
    assert next_choice().runs_compiled, "started again"
    assert not next_choice(sense_only=True).runs_compiled, "poses are taken by hand"
    assert next_choice().runs_compiled, "and the outputs are armed again"
    assert not next_choice(bench=str(SERIAL)).compiled, "another bench"
    assert next_choice(bench=str(SERIAL), compiled=True).runs_compiled
    with pytest.raises(InputError, match="compiled must be true or false"):
        next_choice(compiled=1)
    with pytest.raises(InputError, match="choose one of them"):
        next_choice(compiled=True, sense_only=True)


def test_a_bench_that_cannot_is_refused_before_what_runs_is_ended(tmp_path: Path) -> None:
    session = Session(Choice(DEFAULT_BENCH), tmp_path)
    with pytest.raises(BenchError) as refused:
        asyncio.run(session.start(Choice(EIGHT, compiled=True)))
    assert str(refused.value).startswith(WHY)
    assert (session.run_number, session.choice) == (0, Choice(DEFAULT_BENCH))


# -- the page ------------------------------------------------------------------------------------------------


def test_the_setup_view_starts_one_and_says_which_device_keeps_a_bench_from_it(still_page: Any, still: Still) -> None:
    tab = still_page
    go(tab, "setup")
    tab.wait_for_function(f"document.querySelector('[aria-label=\"Bench to run\"]').value === '{DEFAULT_BENCH}'")
    tab.select_option("[aria-label='Bench to run']", str(EIGHT))
    tab.wait_for_function(f"{SAID}.startsWith('{WHY}')")
    assert tab.locator(SWITCH).is_disabled()
    tab.select_option("[aria-label='Bench to run']", str(SERIAL))
    tab.wait_for_function(f"{SAID} === ''")
    tab.check(SWITCH)
    run = still.session.run_number
    tab.click("text=Run it")
    tab.wait_for_function(f"micron.link.state.run > {run}")
    assert still.session.choice == Choice(SERIAL, compiled=True)
    tab.wait_for_function("document.getElementById('bench-name').textContent.endsWith('· compiled')")
    tab.select_option("[aria-label='Bench to run']", str(EIGHT))
    tab.wait_for_function(f"{SAID}.startsWith('{WHY}')")
    assert not tab.locator(SWITCH).is_checked(), "a bench that cannot is not asked to"


# -- a whole run ---------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def server() -> Iterator[Server]:
    with bench_server("\n[firmware.safety]\nholds_per_minute = 60\n", options=("--stale-ms", "300")) as running:
        yield running


def start_compiled(server: Server) -> dict[str, Any]:
    """Start a compiled run from the page's request; its first status with armed outputs."""
    run = server.state()["run"]
    status, answer = server.request("POST", "/api/firmware/start", b'{"compiled": true}')
    assert status == 200, answer
    return server.wait_for(lambda s: s["run"] > run and s["status"].get("state") == "running", "a compiled run")


def last_outcome(server: Server) -> dict[str, Any]:
    """The outcome of the firmware that has ended and is still the page's."""
    (folder,) = server.folder.glob("micron-bench-*")
    return wait_for_file(folder / "outcome.json")


@pytest.mark.realtime
def test_a_compiled_run_is_shown_recorded_and_ended_by_the_safe_button(server: Server) -> None:
    state = start_compiled(server)
    assert state["compiled"]
    assert state["timing"].keys() >= {"tick", "estimate", "actuate", "sample to command"}
    assert server.request("POST", "/api/recording/start", b'{"name": "compiled", "notes": ""}')[0] == 200
    server.wait_for(lambda s: (s["recording"] or {}).get("written", 0) > 1500, "rows")
    assert server.request("POST", "/api/safe", b"{}")[0] == 200
    ended = server.wait_for(lambda s: s["phase"] == "safe", "the safe state")
    assert ended["reason"] == "stopped by the operator (safe button of the bench page)"
    assert server.request("POST", "/api/recording/stop", b"{}")[0] == 200
    outcome = last_outcome(server)
    assert outcome["safe_state"]["reached"]
    assert outcome["loop"]["kind"] == "compiled"
    assert outcome["loop"]["ticks"] > 500
    assert outcome["clock"] == "real"
    recording = Recording(server.recordings / "compiled.mcap")
    assert recording.n_rows > 1500
    assert not [line for line in recording.health.lines() if "torn" in line]


@pytest.mark.realtime
def test_the_command_starts_the_page_with_a_compiled_run() -> None:
    more = "\n[firmware.safety]\nholds_per_minute = 60\n"
    with bench_server(more, options=("--realtime", "--compiled", "--stale-ms", "300")) as server:
        assert server.state()["compiled"]
        assert server.request("POST", "/api/safe", b"{}")[0] == 200
        server.wait_for(lambda s: s["phase"] == "safe", "the safe state")
        outcome = last_outcome(server)
    assert outcome["loop"]["kind"] == "compiled"
    assert outcome["clock"] == "real"


@pytest.mark.realtime
def test_a_page_that_is_killed_leaves_the_outputs_of_a_compiled_run_at_neutral() -> None:
    """The firmware ends as it does on SIGTERM when its server has gone, and nobody waits for it."""
    with bench_server(options=("--stale-ms", "300")) as server:
        start_compiled(server)
        (folder,) = server.folder.glob("micron-bench-*")
        os.kill(server.process.pid, signal.SIGKILL)
        server.process.wait()
        outcome = wait_for_file(folder / "outcome.json")
    assert outcome["safe_state"]["reached"], outcome["safe_state"]["reason"]
    assert outcome["loop"]["kind"] == "compiled"


def wait_for_file(path: Path) -> dict[str, Any]:
    """The JSON of a file that another process is about to write."""
    limit_s = time.monotonic() + 120.0
    while time.monotonic() < limit_s:
        try:
            return json.loads(path.read_text())
        except (FileNotFoundError, ValueError):
            time.sleep(0.02)
    raise AssertionError(f"{path} was not written")
