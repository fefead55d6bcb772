"""(j) What the bench page costs: the server with one viewer of 20 channels at 60 frames a second, and the firmware's
tick with viewers beside the same without, in turns within one run. A viewer is a process that reads what it is sent,
without drawing. ``make bench ONLY=bench_page`` prints it; ``benchmarks.loop`` takes ``measure`` for its own rows."""

from __future__ import annotations

import json
import os
import subprocess
import sys
import tempfile
import time
import urllib.request
from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from websockets.sync.client import connect

from benchmarks.row import Row
from firmware_py.scheduler.histogram import bucket_bounds_ns, bucket_of
from tools.bench.started import started
from tools.cli.bench_option import bench_path

SECONDS = 10.0
VIEWERS = {0: "no viewer", 1: "one viewer", 12: "twelve viewers"}
ROUNDS = 4
PART_S = 5.0
"""Each number of viewers looks for so long, ``ROUNDS`` times in turns: what else the machine does meets all alike."""
MOST_CORE = {1: 0.10, 12: 0.40}
MOST_RATIO = 1.05
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


@dataclass
class Watched:
    """What was seen with one number of viewers. ``ticks``: lower bound in ns and count of the firmware's ticks."""

    used_s: float = 0.0
    frames: int = 0
    ticks: Counter[int] = field(default_factory=Counter[int])

    def tick_us(self, share: float) -> float:
        """Within its bucket (one sixteenth of an octave) the ticks are taken as spread evenly."""
        wanted, seen = share * self.ticks.total(), 0
        for ns, n in sorted(self.ticks.items()):
            if n and seen + n >= wanted:
                width_ns = bucket_bounds_ns(bucket_of(ns))[1]
                return (ns + width_ns * (wanted - seen) / n) * 1e-3
            seen += n
        return 0.0


def in_turns(bench: Path, *options: str) -> dict[int, Watched]:
    """Server and loop with each number of ``VIEWERS``, in turns within one run. RuntimeError when the run ends."""
    subscription = json.dumps({"type": "subscribe", "id": 1, "channels": CHANNELS, "rows": 5000, "pixels": 1200})
    found = {number: Watched() for number in VIEWERS}
    with (
        tempfile.TemporaryDirectory(prefix="micron-") as folder,
        started("--bench", str(bench), "--recordings", folder, *options) as (server, address),
    ):
        url = address.partition("/#")[0].replace("http", "ws") + "/live"
        while (now := state(url))["status"].get("state") != "running":
            if now["phase"] not in ("starting", "running"):
                raise RuntimeError(f"the firmware did not start: {now['reason']}")
            time.sleep(0.5)
        time.sleep(2.0)
        for _ in range(ROUNDS):
            for number, watched in found.items():
                command = [sys.executable, "-c", VIEWER, url, str(PART_S), subscription]
                viewers = [subprocess.Popen(command, stdout=subprocess.PIPE, text=True) for _ in range(number)]
                time.sleep(1.5)  # until they have started and look
                before, used_s = counts(url), cpu_s(server.pid)
                time.sleep(PART_S - 2.0)
                watched.used_s += cpu_s(server.pid) - used_s
                watched.ticks.update(dict(between(before, counts(url), "tick")))
                watched.frames += sum(int(viewer.communicate(timeout=60)[0]) for viewer in viewers)
        ended = state(url)
        if ended["phase"] != "running":
            raise RuntimeError(f"the firmware went to its safe state, nothing to measure: {ended['reason']}")
    return found


def rows() -> Iterator[Row]:
    """Paced emulated time, as the page runs by default, for the server; the wall clock for the loop's percentiles."""
    paced = in_turns(bench_path(None))
    seconds = ROUNDS * (PART_S - 2.0)
    alone = paced[0].used_s / seconds
    for number, title in VIEWERS.items():
        if not number:
            continue
        share = paced[number].used_s / seconds
        frames = paced[number].frames / (ROUNDS * PART_S * number)
        yield Row(
            f"bench page, server, {title}", f"share of a core, 20 channels at 1 kHz, {frames:.0f} frames a second each",
            share, alone, "no viewer", "cores", share / alone, f"<= {MOST_CORE[number]:.2f}",
            share <= MOST_CORE[number], must=True, why="see the machine's load",
        )  # fmt: skip
    real = in_turns(bench_path(None), "--realtime", "--stale-ms", "200")
    for share in (0.5, 0.9, 0.99):
        peer = real[0].tick_us(share)
        for number, title in VIEWERS.items():
            if not number:
                continue
            mine, n = real[number].tick_us(share), sum(real[number].ticks.values())
            yield Row(
                f"bench page, tick p{100 * share:.0f}, {title}", f"wall clock, {n} ticks",
                mine, peer, "no viewer", "us", mine / peer, f"<= {MOST_RATIO:.2f} x", mine / peer <= MOST_RATIO,
                must=True, why="viewers are processes of the same machine here; the loop does not wait for them",
            )  # fmt: skip
