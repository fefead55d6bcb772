"""(j) What the bench page costs: the server with one viewer of 20 channels at 60 frames a second, and the firmware's
tick with viewers beside the same without, in turns within one run. A viewer is a process that reads what it is sent,
without drawing. Twelve processes cost the loop something on any machine: as many that read as much from a server of
their own, which has nothing to do with the bench, say how much of it. ``make bench ONLY=bench_page`` prints it;
``benchmarks.loop`` takes ``measure`` for its own rows."""

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
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from websockets.sync.client import connect

from benchmarks.row import Row
from firmware_py.scheduler.histogram import bucket_bounds_ns, bucket_of
from tools.cli.bench_option import bench_path
from tools.research.pictures import started

SECONDS = 10.0
NONE, ONE, TWELVE, STRANGERS = "no viewer", "one viewer", "twelve viewers", "twelve strangers"
LOOKS = {NONE: 0, ONE: 1, TWELVE: 12, STRANGERS: 12}
"""Number of processes; the strangers are the control: they read as many bytes as often from a server of their own."""
ROUNDS = 4
PART_S = 5.0
"""Each number of viewers looks for so long, ``ROUNDS`` times in turns: what else the machine does meets all alike."""
MOST_CORE = {ONE: 0.10, TWELVE: 0.40}
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
FRAME_BYTES = 32 + 17 * (8 + 4 * len(CHANNELS))
OTHER_SERVER = """
import asyncio, contextlib, sys
from websockets.asyncio.server import serve
from websockets.exceptions import ConnectionClosed
async def one(ws):
    await ws.recv()
    with contextlib.suppress(ConnectionClosed):
        while True:
            await asyncio.sleep(1 / 60)
            await ws.send(bytes(int(sys.argv[1])))
async def main():
    async with serve(one, "127.0.0.1", 0, compression=None) as server:
        print(server.sockets[0].getsockname()[1], flush=True)
        await asyncio.Future()
asyncio.run(main())
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


def post(address: str, path: str, **table: object) -> None:
    """Make a request of the page at ``address``, as its buttons do."""
    place, _, token = address.partition("/#token=")
    request = urllib.request.Request(
        f"{place}{path}",
        data=json.dumps(table).encode(),
        headers={"x-micron-token": token, "content-type": "application/json"},
    )
    urllib.request.urlopen(request, timeout=60).read()


def record(address: str) -> None:
    """Start a recording, as the page's button does."""
    post(address, "/api/recording/start", name="benchmark", notes="")


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
    """What was seen with one of ``LOOKS``. ``ticks``: lower bound in ns and count of the firmware's ticks; ``parts``:
    the same of each round."""

    used_s: float = 0.0
    frames: int = 0
    ticks: Counter[int] = field(default_factory=Counter[int])
    parts: list[Watched] = field(default_factory=list["Watched"])

    def tick_us(self, share: float) -> float:
        """Within its bucket (one sixteenth of an octave) the ticks are taken as spread evenly."""
        wanted, seen = share * self.ticks.total(), 0
        for ns, n in sorted(self.ticks.items()):
            if n and seen + n >= wanted:
                width_ns = bucket_bounds_ns(bucket_of(ns))[1]
                return (ns + width_ns * (wanted - seen) / n) * 1e-3
            seen += n
        return 0.0


@contextmanager
def other_server() -> Iterator[str]:
    """Address of a server that sends frames of the page's size to whoever asks."""
    command = [sys.executable, "-c", OTHER_SERVER, str(FRAME_BYTES)]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as server:
        assert server.stdout is not None
        yield f"ws://127.0.0.1:{int(server.stdout.readline())}"
        server.kill()


def in_turns(bench: Path, *options: str) -> dict[str, Watched]:
    """Server and loop with each of ``LOOKS``, in turns within one run. RuntimeError when the run ends."""
    subscription = json.dumps({"type": "subscribe", "id": 1, "channels": CHANNELS, "rows": 5000, "pixels": 1200})
    found = {title: Watched() for title in LOOKS}
    with (
        tempfile.TemporaryDirectory(prefix="micron-") as folder,
        started("--bench", str(bench), "--recordings", folder, *options) as (server, address),
        other_server() as elsewhere,
    ):
        url = address.partition("/#")[0].replace("http", "ws") + "/live"
        while (now := state(url))["status"].get("state") != "running":
            if now["phase"] not in ("starting", "running"):
                raise RuntimeError(f"the firmware did not start: {now['reason']}")
            time.sleep(0.5)
        time.sleep(2.0)
        for _ in range(ROUNDS):
            for title, watched in found.items():
                place = elsewhere if title == STRANGERS else url
                command = [sys.executable, "-c", VIEWER, place, str(PART_S), subscription]
                viewers = [subprocess.Popen(command, stdout=subprocess.PIPE, text=True) for _ in range(LOOKS[title])]
                time.sleep(1.5)  # until they have started and look
                before, used_s = counts(url), cpu_s(server.pid)
                time.sleep(PART_S - 2.0)
                watched.used_s += cpu_s(server.pid) - used_s
                part = Watched(ticks=Counter(dict(between(before, counts(url), "tick"))))
                watched.parts.append(part)
                watched.ticks.update(part.ticks)
                watched.frames += sum(int(viewer.communicate(timeout=60)[0]) for viewer in viewers)
        ended = state(url)
        if ended["phase"] != "running":
            raise RuntimeError(f"the firmware went to its safe state, nothing to measure: {ended['reason']}")
    return found


def rows() -> Iterator[Row]:
    """Paced emulated time, as the page runs by default, for the server; the wall clock for the loop's percentiles."""
    paced = in_turns(bench_path(None))
    seconds = ROUNDS * (PART_S - 2.0)
    alone = paced[NONE].used_s / seconds
    for title, most in MOST_CORE.items():
        share = paced[title].used_s / seconds
        frames = paced[title].frames / (ROUNDS * PART_S * LOOKS[title])
        yield Row(
            f"bench page, server, {title}", f"share of a core, 20 channels at 1 kHz, {frames:.0f} frames a second each",
            share, alone, NONE, "cores", share / alone, f"<= {most:.2f}",
            share <= most, must=True, why="see the machine's load",
        )  # fmt: skip
    real = in_turns(bench_path(None), "--realtime", "--stale-ms", "200")
    for share in (0.5, 0.9, 0.99):
        peer = real[NONE].tick_us(share)
        for title in (ONE, TWELVE, STRANGERS):
            mine, n = real[title].tick_us(share), sum(real[title].ticks.values())
            parts = sorted(part.tick_us(share) / peer for part in real[title].parts)
            is_ours = title != STRANGERS
            yield Row(
                f"bench page, tick p{100 * share:.0f}, {title}",
                f"wall clock, {n} ticks; {len(parts)} parts {parts[0]:.2f} to {parts[-1]:.2f}",
                mine, peer, NONE, "us", mine / peer, f"<= {MOST_RATIO:.2f} x" if is_ours else "-",
                mine / peer <= MOST_RATIO if is_ours else None, must=is_ours,
                why="viewers are processes of this machine; strangers say what as many cost by themselves",
            )  # fmt: skip
