"""The end of the page's process: the outputs come first, open pages are closed, and a second signal ends it at once."""

from __future__ import annotations

import signal
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

import pytest
from websockets.exceptions import ConnectionClosed
from websockets.sync.client import ClientConnection, connect

from tests.conftest import DEFAULT_BENCH

ROOT = Path(__file__).parents[2]
PATIENCE_S = 120
SERVER = """
import asyncio, sys
from pathlib import Path
from tools.bench.firmware import Choice
from tools.bench.serve import LOOPBACK, bind, serve
from tools.bench.session import Session

class Slow(Session):
    async def start(self, choice=None):
        self.stops = 0

    async def stop(self):
        self.stops += 1
        if self.stops == 1:
            print("stopping", flush=True)
            await asyncio.sleep(600 if sys.argv[3] == "hangs" else 0)
            print("neutral", flush=True)

import tools.bench.serve
tools.bench.serve.Session = Slow
try:
    serve(Choice(Path(sys.argv[1])), Path(sys.argv[2]), bind(LOOPBACK, 0), lambda at: print(at, flush=True))
except KeyboardInterrupt:
    print("interrupted", flush=True)
"""


@contextmanager
def served(tmp_path: Path, stop: str) -> Iterator[tuple[subprocess.Popen[str], ClientConnection]]:
    """The page's process, whose firmware ``stop`` "ends" or "hangs", and a page that is open and reads nothing."""
    command = [sys.executable, "-c", SERVER, str(DEFAULT_BENCH), str(tmp_path), stop]
    process = subprocess.Popen(command, cwd=ROOT, stdout=subprocess.PIPE, text=True)
    try:
        assert process.stdout is not None
        base = process.stdout.readline().partition("/#token=")[0]
        with connect(base.replace("http", "ws") + "/live", open_timeout=PATIENCE_S, close_timeout=0.1) as viewer:
            viewer.recv(PATIENCE_S)
            yield process, viewer
    finally:
        process.kill()
        process.wait()
        if process.stdout is not None:
            process.stdout.close()


def read_until_closed(viewer: ClientConnection) -> int:
    """The code with which the server closed the connection."""
    with suppress(ConnectionClosed):
        while True:
            viewer.recv(PATIENCE_S)
    return viewer.close_code or 0


@pytest.mark.parametrize(("number", "last"), [(signal.SIGINT, "interrupted"), (signal.SIGTERM, "neutral")])
def test_one_signal_stops_the_firmware_and_waits_for_it(tmp_path: Path, number: signal.Signals, last: str):
    with served(tmp_path, "ends") as (process, viewer):
        process.send_signal(number)
        said = process.communicate(timeout=PATIENCE_S)[0].split()
        assert said[:2] == ["stopping", "neutral"]
        assert said[-1] == last
        assert process.returncode == 0
        assert read_until_closed(viewer) == 1012  # "service restart": the page asks again


@pytest.mark.parametrize("second", [signal.SIGINT, signal.SIGTERM])
def test_a_second_signal_ends_a_page_whose_firmware_hangs(tmp_path: Path, second: signal.Signals):
    with served(tmp_path, "hangs") as (process, viewer):
        process.send_signal(signal.SIGINT)
        assert process.stdout is not None
        assert process.stdout.readline() == "stopping\n"
        assert read_until_closed(viewer) == 1012  # nobody waits for the firmware to be told that the page ends
        assert process.poll() is None
        process.send_signal(second)
        assert process.wait(PATIENCE_S) == -second
