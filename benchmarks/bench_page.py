"""(j) What the bench page costs: the server with one viewer of 20 channels at 60 frames a second, and the firmware's
tick with a viewer beside the same without. The viewer is a process that reads what it is sent, without drawing.
``benchmarks.loop`` makes rows of it."""

from __future__ import annotations

import json
import os
import subprocess
import sys
import tempfile
import time
import urllib.request
from pathlib import Path
from typing import Any

from websockets.sync.client import connect

from tools.bench.started import started

SECONDS = 10.0
PERIOD_NS = 1_000_000
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


Counts = dict[str, dict[int, int]]


def counts(url: str) -> Counts:
    """Counts of the firmware's histograms ``tick`` and ``lateness`` by lower bound in ns."""
    with connect(url) as ws:
        ws.send('{"type": "counts", "on": true}')
        while True:
            message = ws.recv(60)
            if isinstance(message, str) and (table := json.loads(message))["type"] == "counts":
                found = {name: table["counts"][name] for name in ("tick", "lateness")}
                return {name: dict(zip(c["ns"], c["n"], strict=True)) for name, c in found.items()}


def between(before: Counts, after: Counts, name: str) -> list[tuple[int, int]]:
    """(lower bound ns, count) of what came between two looks."""
    return sorted((ns, n - before[name].get(ns, 0)) for ns, n in after[name].items())


def quantile_us(found: list[tuple[int, int]], share: float) -> float:
    """To the width of a bucket."""
    wanted, seen = share * sum(n for _, n in found), 0
    for ns, n in found:
        seen += n
        if seen >= wanted:
            return ns * 1e-3
    return 0.0


def record(address: str) -> None:
    """Start a recording, as the page's button does."""
    place, _, token = address.partition("/#token=")
    request = urllib.request.Request(
        f"{place}/api/recording/start",
        data=json.dumps({"name": "benchmark", "notes": ""}).encode(),
        headers={"x-micron-token": token, "content-type": "application/json"},
    )
    urllib.request.urlopen(request, timeout=60).read()


def measure(bench: Path) -> dict[str, float]:
    """On ``bench``: share of a core, frames a second, p99 of the tick without and with the viewer (us); with viewer,
    telemetry and a recording: lateness (us), the part of the ticks that began a period late or were skipped (%)."""
    subscription = json.dumps({"type": "subscribe", "id": 1, "channels": CHANNELS, "rows": 5000, "pixels": 1200})
    with (
        tempfile.TemporaryDirectory(prefix="micron-") as folder,
        started("--bench", str(bench), "--recordings", folder) as (server, address),
    ):
        url = address.partition("/#")[0].replace("http", "ws") + "/live"
        while state(url)["status"].get("state") != "running":
            time.sleep(0.5)
        time.sleep(2.0)
        record(address)
        time.sleep(1.0)
        start = counts(url)
        time.sleep(SECONDS)
        alone = counts(url)
        skipped = state(url)["status"]["skipped"]
        used_s = cpu_s(server.pid)
        viewer = subprocess.run(
            [sys.executable, "-c", VIEWER, url, str(SECONDS), subscription],
            capture_output=True, text=True, check=True,
        )  # fmt: skip
        used_s = cpu_s(server.pid) - used_s
        watched = counts(url)
        ended = state(url)
        if ended["phase"] == "safe":
            raise RuntimeError(f"the firmware went to its safe state, nothing to measure: {ended['reason']}")
        skipped = ended["status"]["skipped"] - skipped
    late = between(alone, watched, "lateness")
    ticks = sum(n for _, n in late) + skipped
    return {
        "core": used_s / SECONDS,
        "frames_per_s": int(viewer.stdout) / SECONDS,
        "alone_us": quantile_us(between(start, alone, "tick"), 0.99),
        "watched_us": quantile_us(between(alone, watched, "tick"), 0.99),
        "late_p99_us": quantile_us(late, 0.99),
        "late_p999_us": quantile_us(late, 0.999),
        "missed": 100.0 * (sum(n for ns, n in late if ns >= PERIOD_NS) + skipped) / ticks,
    }
