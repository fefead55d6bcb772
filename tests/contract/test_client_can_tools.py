"""The emulated CAN node with the command lines of python-can and cantools, which take their bus from variables."""

from __future__ import annotations

from pathlib import Path

import pytest

from drivers import dbc
from tests.contract.emulated_client import run_client

pytestmark = [pytest.mark.realtime, pytest.mark.slow]

# the screen programs run in a pty of their own, and are left with the key that their help names
PROGRAM = """
import json, os, pty, select, signal, subprocess, sys, time
import can

def watch(*command, want, seconds=30.0):
    leader, follower = pty.openpty()
    terminal = {**os.environ, "TERM": "xterm"}
    child = subprocess.Popen(command, stdin=follower, stdout=follower, stderr=follower, env=terminal)
    os.close(follower)
    screen, until = b"", time.monotonic() + seconds
    while not all(w in screen for w in want) and time.monotonic() < until:
        if select.select([leader], [], [], 0.1)[0]:
            try:
                screen += os.read(leader, 65536)
            except OSError:
                break
    os.write(leader, b"q")
    try:
        status = child.wait(10)
    except subprocess.TimeoutExpired:
        child.kill()
        status = None
    seen = [w.decode() for w in want if w in screen]
    return {"seen": seen, "status": status, "screen": screen[-800:].decode("latin-1")}

logger = subprocess.Popen([sys.executable, "-m", "can.logger", "-f", "frames.asc"], stdout=subprocess.DEVNULL)
result = {
    "viewer": watch(sys.executable, "-m", "can.viewer", "-i", os.environ["CAN_INTERFACE"], want=[b"0x121", b"Count"]),
    "monitor": watch(sys.executable, "-m", "cantools", "monitor", DATABASE, want=[b"STATUS", b"measured_1"]),
}
logger.send_signal(signal.SIGINT)
logger.wait(10)
lines = [line.split() for line in open("frames.asc")]
result["logged"] = sum(len(line) > 2 and line[2] == "121" for line in lines)
print(json.dumps(result))
"""


def test_viewer_monitor_and_logger_see_the_node(tmp_path: Path) -> None:
    database = Path(dbc.__file__).with_name("micron.dbc")
    seen = run_client(tmp_path, f"DATABASE = {str(database)!r}\n{PROGRAM}")
    assert seen["viewer"]["seen"] == ["0x121", "Count"], seen["viewer"]["screen"]
    assert seen["monitor"]["seen"] == ["STATUS", "measured_1"], seen["monitor"]["screen"]
    assert seen["logged"] > 10
