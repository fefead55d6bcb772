"""A session of the page in this process, with a real firmware of the endoscope: rows, a recording, orders, the end."""

from __future__ import annotations

import asyncio
import json
import os
import signal
from collections.abc import Awaitable, Callable
from pathlib import Path

import numpy as np
import pytest

from firmware_py.endoscope.frame import LAYOUT
from firmware_py.recording.reader import Recording
from hal.errors import BenchError
from tests.conftest import DEFAULT_BENCH
from tools.bench.firmware import Choice
from tools.bench.session import Session
from tools.errors import InputError

pytestmark = pytest.mark.timeout(200)
ENDOSCOPE = DEFAULT_BENCH.with_name("endoscope.toml")


def with_session(folder: Path, work: Callable[[Session], Awaitable[None]]) -> Session:
    """Run ``work`` beside a session whose firmware has started; the firmware has ended when this returns."""

    async def whole() -> Session:
        session = Session(Choice(ENDOSCOPE), folder)
        pump = asyncio.create_task(session.run_forever())
        await session.start()
        try:
            await until(lambda: session.run.phase == "running" and session.history.head > 30)
            await work(session)
        finally:
            await session.stop()
            pump.cancel()
            await asyncio.gather(pump, return_exceptions=True)
        return session

    return asyncio.run(whole())


def written(session: Session) -> int:
    """Rows that are in the file of the recording that runs."""
    return (session.recorder.state() or {"written": 0})["written"]


async def until(good: Callable[[], bool]) -> None:
    while not good():
        await asyncio.sleep(0.02)


def test_a_run_from_its_first_row_to_the_safe_state(tmp_path: Path):
    async def work(session: Session) -> None:
        assert (session.run.rate_hz, session.run.has_outputs) == (100.0, False)
        assert session.state()["devices"].keys() == {"imu", "card"}
        await session.start_recording("first", "a note at the start")
        with pytest.raises(InputError, match="running already"):
            await session.start_recording("second", "")
        await until(lambda: written(session) > 60)
        session.recorder.note("turned by hand", session.bench_time_ns())
        assert session.recorder.trouble() == ""
        with pytest.raises(InputError, match=r"\[firmware\] fusion"):
            await session.compare("observer")
        assert session.counts()["arrival to view"]["n"]
        newest = session.history.buckets(np.array([LAYOUT.start("view_x")]), 1, session.history.head - 5)
        assert (newest.low > 0.0).all()
        assert session.order("safe")
        await until(lambda: session.run.phase == "safe")

    session = with_session(tmp_path, work)
    (alert,) = (alert for alert in session.alerts() if "Safe state" in alert["text"])
    assert alert["text"].startswith("Safe state, the view stands still: ")
    assert session.run.outcome is not None
    assert session.run.outcome["safe_state"]["finding"] == "stopped_on_page"
    recording = Recording(tmp_path / "first.mcap")
    assert recording.names == LAYOUT.scalar_names()
    assert recording.n_rows > 60
    assert [e.content["text"] for e in recording.events if e.content["event"] == "note"] == ["turned by hand"]
    notes = json.loads((tmp_path / "first.json").read_text())
    assert notes["notes"] == ["a note at the start", "turned by hand"]
    assert (notes["ticks"], notes["dropped"], notes["problem"]) == (recording.n_rows, 0, "")
    assert not session.order("safe"), "nobody is left to obey"


def test_a_firmware_that_dies_leaves_its_recording_and_says_what_to_do(tmp_path: Path):
    async def work(session: Session) -> None:
        await session.start_recording("until it died", "")
        await until(lambda: written(session) > 40)
        assert session.firmware is not None
        os.kill(session.firmware.pid, signal.SIGKILL)
        await until(lambda: session.run.phase == "failed")

    session = with_session(tmp_path, work)
    (said,) = (alert["text"] for alert in session.alerts() if "died" in alert["text"])
    assert said.endswith("Start it again.")
    assert "amplifier" not in said, "this instrument has none"
    assert Recording(tmp_path / "until it died.mcap").n_rows > 40


def test_a_bench_that_is_wrong_leaves_the_run_as_it_is(tmp_path: Path):
    async def work(session: Session) -> None:
        wrong = tmp_path / "wrong.toml"
        wrong.write_text(ENDOSCOPE.read_text().replace("format = 1", "format = 7"))
        run, rows = session.run_number, session.history.head
        with pytest.raises(BenchError, match="format"):
            await session.start(Choice(wrong))
        assert session.run_number == run
        await until(lambda: session.history.head > rows + 20)

    assert with_session(tmp_path, work).run.phase in ("safe", "running")
