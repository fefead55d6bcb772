"""What the bench page costs: the server with one viewer of 20 channels at 60 frames a second, and the firmware's tick
with a viewer beside the same without. The viewer is a process that reads as fast as it is sent to, without drawing."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from websockets.sync.client import connect

from benchmarks.row import Row

SECONDS = 10.0
CHANNELS = [f"volts_{i}" for i in range(8)] + [f"accelerometer_{a}" for a in ("1x", "1z", "2y", "2z", "3x", "3y")]
CHANNELS += [f"magnetometer_{a}" for a in "xyz"] + [f"command_{i}" for i in (1, 2, 3)]
VIEWER = """
import json, sys, time
from websockets.sync.client import connect
url, seconds, subscription = sys.argv[1], float(sys.argv[2]), sys.argv[3]
frames = 0
with connect(url) as ws:
    ws.send(subscription)
    end = time.monotonic() + seconds
    while time.monotonic() < end:
        frames += isinstance(ws.recv(10), bytes)
print(frames)
"""


def cpu_s(pid: int) -> float:
    """User and system time of a process so far."""
    fields = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()
    return (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")


def state(url: str) -> dict[str, Any]:
    """One status message."""
    with connect(url, open_timeout=60) as ws:
        while True:
            message = ws.recv(60)
            if isinstance(message, str) and (table := json.loads(message))["type"] == "state":
                return table


def tick_counts(url: str) -> dict[int, int]:
    """Counts of the tick histogram by lower bound in ns."""
    with connect(url) as ws:
        ws.send('{"type": "counts", "on": true}')
        while True:
            message = ws.recv(60)
            if isinstance(message, str) and (table := json.loads(message))["type"] == "counts":
                return dict(zip(table["counts"]["tick"]["ns"], table["counts"]["tick"]["n"], strict=True))


def p99_us(before: dict[int, int], after: dict[int, int]) -> float:
    """Of the ticks between two looks, to the width of a bucket."""
    counts = sorted((ns, n - before.get(ns, 0)) for ns, n in after.items())
    wanted, seen = 0.99 * sum(n for _, n in counts), 0
    for ns, n in counts:
        seen += n
        if seen >= wanted:
            return ns * 1e-3
    return 0.0


def measure() -> dict[str, float]:
    """Share of a core, frames a second, p99 of the tick without and with the viewer (us)."""
    subscription = json.dumps({"type": "subscribe", "id": 1, "channels": CHANNELS, "rows": 5000, "pixels": 1200})
    with tempfile.TemporaryDirectory(prefix="micron-") as folder:
        command = [sys.executable, "-m", "tools.cli.main", "bench", "--port", "0", "--stale-ms", "1000"]
        server = subprocess.Popen(
            [*command, "--recordings", folder], stderr=subprocess.PIPE, text=True, env={**os.environ, "COLUMNS": "400"}
        )
        try:
            assert server.stderr is not None
            address = next(word for word in server.stderr.readline().split() if word.startswith("http"))
            url = address.partition("/#")[0].replace("http", "ws") + "/live"
            while state(url)["status"].get("state") != "running":
                time.sleep(0.5)
            time.sleep(2.0)
            start = tick_counts(url)
            time.sleep(SECONDS)
            alone = tick_counts(url)
            used_s = cpu_s(server.pid)
            viewer = subprocess.run(
                [sys.executable, "-c", VIEWER, url, str(SECONDS), subscription],
                capture_output=True, text=True, check=True,
            )  # fmt: skip
            used_s = cpu_s(server.pid) - used_s
            watched = tick_counts(url)
        finally:
            server.send_signal(signal.SIGTERM)
            server.communicate(timeout=60)
    return {
        "core": used_s / SECONDS,
        "frames_per_s": int(viewer.stdout) / SECONDS,
        "alone_us": p99_us(start, alone),
        "watched_us": p99_us(alone, watched),
    }


def rows() -> Iterator[Row]:
    found = measure()
    yield Row(
        "bench page, server",
        f"share of a core: 20 channels at 1 kHz, one viewer that got {found['frames_per_s']:.1f} frames a second",
        found["core"], 1.0, "one core", "cores", found["core"], "<= 0.10", found["core"] <= 0.10,
    )  # fmt: skip
    ratio = found["watched_us"] / found["alone_us"]
    yield Row(
        "bench page, tick p99", "firmware's tick with a viewer, against the same run without", found["watched_us"],
        found["alone_us"], "no viewer", "us", ratio, "<= 1.2 x", ratio <= 1.2,
    )  # fmt: skip


if __name__ == "__main__":
    for row in rows():
        print(f"{row.name}: {row.ours:.3g} {row.unit}, ratio {row.ratio:.3g} ({row.goal}); {row.what}")
