"""A firmware that is killed: the page says what to do, keeps what was recorded, and starts it again."""

from __future__ import annotations

import os
import signal
from pathlib import Path
from typing import Any

import pytest

from firmware_py.recording.reader import Recording
from tests.bench.conftest import Server, go
from tests.conftest import DEFAULT_BENCH
from tools.bench.firmware import Choice
from tools.bench.session import Session

pytestmark = pytest.mark.timeout(400)


def test_a_firmware_that_never_ran_and_one_that_died_are_told_apart(tmp_path: Path):
    session = Session(Choice(DEFAULT_BENCH), tmp_path)
    session._on_end(session.run, None, "no module named x")
    assert session.alerts()[0] == {"kind": "error", "text": "The firmware did not start: no module named x"}
    session.run.status = {"t_s": 3.0}
    session._on_end(session.run, None, "it ended with code -9")
    said = session.alerts()[0]["text"]
    assert "it ended with code -9" in said
    assert "switch the amplifier off" in said


def firmware_pid(server: Server) -> int:
    """The child of the server that runs the firmware."""
    children = Path(f"/proc/{server.process.pid}/task/{server.process.pid}/children").read_text().split()
    for pid in children:
        if b"firmware_py.app" in Path(f"/proc/{pid}/cmdline").read_bytes():
            return int(pid)
    raise AssertionError("no firmware runs")


def test_a_killed_firmware_is_said_its_recording_is_kept_and_it_starts_again(page: Any, server: Server):
    go(page, "collect")
    page.fill("input[placeholder^='Name']", "until it died")
    page.click("#rec-start")
    server.wait_for(lambda s: (s["recording"] or {}).get("written", 0) > 300, "rows")
    os.kill(firmware_pid(server), signal.SIGKILL)
    page.wait_for_selector("#alerts >> text=The firmware died")
    assert "switch the amplifier off" in page.locator("#alerts").inner_text()
    assert page.locator("#phase").inner_text() == "failed"
    run = server.state()["run"]
    page.click("#alerts button:has-text('Start again')")
    server.wait_for(lambda s: s["run"] > run and s["phase"] == "running", "the next run", 220)
    page.wait_for_function("!document.getElementById('alerts').innerText.includes('died')")
    go(page, "scope")
    page.wait_for_function("micron.scope.subscription.buckets.n > 100")
    recording = Recording(server.recordings / "until it died.mcap")
    assert recording.n_rows > 300
    assert not [line for line in recording.health.lines() if "torn" in line]
