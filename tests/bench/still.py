"""A bench page over data that stand still: no firmware, no real time, the same picture at every start.

The history is filled once with a made-up run (tremor of 9.5 Hz, eight inputs at different levels). Orders are noted
and not carried out. The layout, the colours and the controls of the page are tested on it.
"""

from __future__ import annotations

import asyncio
import json
import os
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import uvicorn
from numpy.typing import NDArray

from firmware_py.frame import LAYOUT
from tests.conftest import DEFAULT_BENCH
from tools.bench.app import make_app
from tools.bench.firmware import Choice
from tools.bench.history import History
from tools.bench.jobs import Jobs
from tools.bench.layouts import Layouts
from tools.bench.routes import more_routes
from tools.bench.serve import LOOPBACK, access_for, bind, config_for
from tools.bench.session import Disk, Session
from tools.bench.targets import Targets

SECONDS = 12
RATE_HZ = 1000
TREMOR_HZ = 9.5
TOKEN = "a-token-that-is-only-used-in-tests"
TASKS = {  # name: rate in Hz, budget in us, p50, p99, p99.9 and worst in us
    "tick": (1000, 1000, 310.0, 420.0, 510.0, 640.0),
    "sense": (1000, 200, 120.0, 160.0, 190.0, 230.0),
    "estimate": (1000, 150, 60.0, 85.0, 99.0, 120.0),
    "actuate": (1000, 150, 70.0, 90.0, 130.0, 180.0),
    "supervise": (100, 300, 40.0, 55.0, 70.0, 95.0),
}


def made_up_rows() -> NDArray[np.float64]:
    """Frames [n, columns] of ``SECONDS`` s: a hand that trembles, outputs that follow it, noise from a fixed seed."""
    rng = np.random.default_rng(27)
    n = SECONDS * RATE_HZ
    t_s = np.arange(n) / RATE_HZ
    rows = np.zeros((n, LAYOUT.size))
    names = LAYOUT.scalar_names()

    def put(name: str, values: NDArray[np.float64] | float) -> None:
        rows[:, names.index(name)] = values

    put("tick", np.arange(n))
    put("t", t_s)
    envelope = 1.0 + 0.25 * np.sin(2 * np.pi * 0.3 * t_s)
    for i, axis in enumerate("xyz"):
        wave = np.sin(2 * np.pi * TREMOR_HZ * t_s + 2.1 * i)
        tremor_m = (40e-6, 30e-6, 12e-6)[i] * envelope * wave
        for name in ("tip_displacement", "tremor", "tremor_ahead", "desired_tip"):
            put(f"{name}_{axis}", (-tremor_m if name == "desired_tip" else tremor_m) + 2e-7 * rng.standard_normal(n))
        put(f"tremor_frequency_{axis}", TREMOR_HZ + 0.1 * np.sin(t_s + i))
        put(f"tremor_amplitude_{axis}", (40e-6, 30e-6, 12e-6)[i] * envelope)
        put(f"confidence_{axis}", 1.0)
        put(f"rate_{axis}", 0.02 * np.sin(2 * np.pi * 0.5 * t_s + i) + 1e-3 * rng.standard_normal(n))
        put(f"specific_force_{axis}", (0.3, -0.4, 9.79)[i] + 0.05 * rng.standard_normal(n))
        put(f"magnetometer_{axis}", (18.0, -3.0, -44.0)[i] + 0.2 * rng.standard_normal(n))
    for i in range(3):
        put(f"stroke_{i + 1}", 5e-6 * envelope * np.sin(2 * np.pi * TREMOR_HZ * t_s + 2.1 * i))
        put(f"command_{i + 1}", 50 + 22 * envelope * np.sin(2 * np.pi * TREMOR_HZ * t_s + 2.1 * i + 0.2))
    for i in range(8):
        put(
            f"volts_{i}", 0.6 + 0.5 * i + 0.02 * np.sin(2 * np.pi * TREMOR_HZ * t_s + i) + 1e-3 * rng.standard_normal(n)
        )
    put("quaternion_w", 0.98)
    put("quaternion_x", 0.199)
    put("supply", 3.3)
    put("temperature", 31.0 + 0.02 * t_s)
    put("status", 128.0)
    return rows


def status() -> dict[str, Any]:
    """What the firmware's status line would say at the end of the made-up run."""
    n = SECONDS * RATE_HZ
    return {
        "t_s": float(SECONDS), "state": "running", "manual": "off", "gain": 1.0, "lost": 0, "skipped": 0,
        "amplitude_um": [40.0, 30.0, 12.0], "frequency_hz": [9.5, 9.5, 9.5], "samples": n, "commands": n, "clipped": 0,
        "tasks": {name: [row[0], row[1], n, 0, 0, 0] for name, row in TASKS.items()},
    }  # fmt: skip


class StillSession(Session):
    """A session whose run has ended before anybody looks, and which still says that it runs."""

    def __init__(self, recordings: Path, read_clock_s: Callable[[], float]) -> None:
        super().__init__(Choice(DEFAULT_BENCH), recordings)
        self.targets = Targets(recordings / "targets", read_clock_s)
        self.layouts = Layouts(recordings.parent / "layouts")  # the bench file is one of the project
        self.orders: list[str] = []

    async def start(self, choice: Choice | None = None) -> None:
        self.choice = choice or self.choice
        self.run_number += 1
        self.run.phase = "running"
        self.run.status = status()
        self.history = History(self.layout)
        self.history.append(made_up_rows())

    async def stop(self) -> None:
        pass

    def order(self, order: str, **values: Any) -> bool:
        self.orders.append(order)
        return True

    def stale_s(self) -> float:
        return 0.0

    def state(self) -> dict[str, Any]:
        self.disk = Disk(200 << 30, 400 << 30)
        timing = {name: [1000.0, *row[2:], 17.0] for name, row in TASKS.items()}
        timing["sample to command"] = [1000.0, 640.0, 810.0, 900.0, 1100.0, 17.0]
        return {**super().state(), "timing": timing}

    def counts(self) -> dict[str, dict[str, list[int]]]:
        found: dict[str, dict[str, list[int]]] = {}
        for name, row in {**TASKS, "sample to command": (0, 0, 640.0, 810.0, 900.0, 1100.0)}.items():
            width = int(row[2] * 100)
            found[name] = {
                "ns": [int(row[2] * 600) + k * width for k in range(6)],
                "w": [width] * 6,
                "n": [5, 400, 900, 300, 40, 2],
            }
        return found

    def metadata(self) -> dict[str, Any]:
        return {"stages": json.dumps({"sensing": {"attitude_method": "observer"}})}


def fill(recordings: Path) -> None:
    """Three entries for the list of recordings; the files themselves are empty."""
    recordings.mkdir(parents=True, exist_ok=True)
    for i, name in enumerate(("first hand", "run 2026-11-01 12.30.05", "a recording with a long name and much to say")):
        file = recordings / f"{name}.mcap"
        file.write_bytes(bytes(1000 * (i + 1)))
        os.utime(file, (1.79e9 + i, 1.79e9 + i))
        notes = ["probe 3, holder changed", "the cable was moved after the first minute"]
        sidecar = {"notes": notes[: i + 1], "ticks": 60_000 * (i + 1), "rate_hz": "1000", "dropped": 3 if i == 1 else 0}
        file.with_suffix(".json").write_text(json.dumps(sidecar), encoding="utf-8")


@dataclass
class Still:
    """A served page. ``address`` has the token in it."""

    session: StillSession
    base: str
    token: str = TOKEN

    @property
    def place(self) -> tuple[str, int]:
        """Address and port, for a socket."""
        host, _, port = self.base.removeprefix("http://").partition(":")
        return host, int(port)

    @property
    def address(self) -> str:
        return f"{self.base}/#token={self.token}"


@contextmanager
def still_server(
    recordings: Path,
    *,
    open_reading: bool = True,
    token: str = TOKEN,
    port: int = 0,
    read_clock_s: Callable[[], float] = time.monotonic,
) -> Iterator[Still]:
    """The page's own routes and guard in a thread of this process, on ``port`` (0: a free one). ``read_clock_s`` is
    the time of the targeting experiment."""
    fill(recordings)
    sock = bind(LOOPBACK, port)
    port = sock.getsockname()[1]
    ready = threading.Event()
    held: list[Any] = []

    async def run() -> None:
        session, jobs = StillSession(recordings, read_clock_s), Jobs()
        access = replace(access_for(LOOPBACK, port, token), open_reading=open_reading)
        app = make_app(session, access, more_routes(session, jobs))
        server = uvicorn.Server(config_for(app))
        held.extend((session, server))
        ready.set()
        await server.serve(sockets=[sock])
        await jobs.close()

    thread = threading.Thread(target=lambda: asyncio.run(run()), daemon=True)
    thread.start()
    assert ready.wait(30)
    try:
        yield Still(held[0], f"http://{LOOPBACK}:{port}", token)
    finally:
        held[1].should_exit = True
        thread.join(30)
        sock.close()
