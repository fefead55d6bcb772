"""Runs one firmware for the page, with its history, one recording and the viewers' orders."""

from __future__ import annotations

import asyncio
import contextlib
import json
import secrets
import shutil
import time
from collections import deque
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from firmware_py.frame import Layout
from firmware_py.layouts import layout_of
from hal.bench import load_bench
from tools.bench.dropped_files import Dropped
from tools.bench.firmware import Choice, Firmware
from tools.bench.history import Buckets, History
from tools.bench.hold_spans import HoldSpans
from tools.bench.layouts import Layouts
from tools.bench.recorder import RunRecorder
from tools.bench.replay import rate_of
from tools.bench.shadow import Shadow, make_shadow
from tools.bench.targets import Targets
from tools.bench.twin_watch import TwinWatch

if TYPE_CHECKING:
    from tools.mismatch.watch.live import Settings

FRAME_S = 1 / 60
STATUS_S = 0.1
DISK_S = 2.0
STALE_S = 0.25
OPERATOR = "the operator"
"""Text of a hold that waits only for a person (``firmware_py.run.holds``)."""
DISK_LOW_BYTES = 2 << 30
DISK_LOW_SHARE = 0.03


@dataclass
class Disk:
    """Room where recordings go."""

    free_bytes: int = 0
    total_bytes: int = 1

    @property
    def low(self) -> bool:
        return self.free_bytes < max(DISK_LOW_BYTES, DISK_LOW_SHARE * self.total_bytes)


@dataclass
class Run:
    """Holds the reported state of one firmware process. ``phase`` is starting, running, safe, ended or failed;
    ``rate_hz`` is the rate of its rows, ``has_outputs`` says whether something of it moves."""

    rate_hz: float
    phase: str = "starting"
    reason: str = ""
    reached: bool = False
    normal: bool = False
    status: dict[str, Any] = field(default_factory=dict[str, Any])
    devices: dict[str, str] = field(default_factory=dict[str, str])
    histograms: list[str] = field(default_factory=list[str])
    has_outputs: bool = True
    safe_ms: float | None = None
    outcome: dict[str, Any] | None = None

    @property
    def at_rest(self) -> str:
        """Return what a hold and the safe state mean for the instrument, in words."""
        return "outputs at neutral" if self.has_outputs else "the view stands still"


class Session:
    """The bench as all viewers see it. ``run_forever`` is its one task; everything else is called from the loop."""

    def __init__(self, choice: Choice, recordings: Path, watch: Settings | None = None) -> None:
        self.choice = choice
        self.home = choice.bench.parent  # folder of the benches to choose from; copies run from elsewhere
        self.identity = secrets.token_hex(8)  # tells an open page that the server is another one
        self.layouts = Layouts(self.home / "layouts")
        self.bench = load_bench(choice.bench)
        self.firmware: Firmware | None = None
        self.run = self._new_run()
        self.run_number = 0
        self.history = History(self.layout)
        self.holds = HoldSpans()
        self.recorder = RunRecorder(recordings)
        self.dropped = Dropped(recordings)
        self.targets = Targets(recordings / "targets")
        self.disk = Disk()
        self.shadow: Shadow | None = None
        self.watch = TwinWatch(watch)
        self.log: deque[dict[str, Any]] = deque(maxlen=500)
        self.log_number = 0
        self.missed_rows = 0
        self.frame_ready = asyncio.Event()
        self._frame_buckets: dict[tuple[bytes, int, int], Buckets] = {}
        self._state_text = ""
        self._state_s = -STATUS_S
        self._row = 0
        self._held_by = ""
        self._fresh_s = time.monotonic()
        self._lock = asyncio.Lock()

    @property
    def layout(self) -> Layout:
        """Return the layout of the frames of the instrument that the bench file describes."""
        return layout_of(self.bench.description)

    def _new_run(self) -> Run:
        """Return the state of a run that begins. Its rate is the tick's until the devices are open."""
        return Run(float(self.bench.description.clock.tick_hz))

    # -- firmware -------------------------------------------------------------------------------------------

    async def start(self, choice: Choice | None = None) -> None:
        """End what runs and start again as ``choice`` says. ``HalError``, and nothing ends, for a wrong bench."""
        async with self._lock:
            bench = load_bench((choice := choice or self.choice).bench)
            await asyncio.to_thread(choice.check, bench)
            await self._end()
            self.choice, self.bench = choice, bench
            self.run, self.history, self._row, self.shadow = self._new_run(), History(self.layout), 0, None
            self.holds = HoldSpans()
            self._frame_buckets.clear()
            self._state_s = -STATUS_S
            self.run_number += 1
            run = self.run
            await asyncio.to_thread(self.watch.begin, bench, self.choice)
            self.note("info", f"starting {bench.description.name} ({choice.bench})")
            self.firmware = await Firmware.start(
                self.choice,
                self.layout.size,
                lambda line: self._on_line(run, line),
                lambda outcome, failure: self._on_end(run, outcome, failure),
            )
            self._fresh_s = time.monotonic()

    async def stop(self) -> None:
        """End firmware and recording, in that order: the ramp belongs into the recording."""
        async with self._lock:
            await self._end()

    async def _end(self) -> None:
        if self.firmware is None:
            return
        await self.firmware.stop()
        self._take_rows()
        if self.recorder.active:
            await self.stop_recording()
        self.firmware.close()
        self.firmware = None
        await asyncio.to_thread(self.watch.end)

    def order(self, order: str, **values: Any) -> bool:
        """Pass an order on to the firmware."""
        return self.firmware is not None and self.firmware.order(order, **values)

    def _on_line(self, run: Run, line: dict[str, Any]) -> None:
        event = line.get("event")
        if event == "devices":
            run.devices, run.histograms = line["identities"], line["histograms"]
            run.has_outputs = line["has_outputs"]
            run.rate_hz = rate_of(self.metadata().get("tick_hz"))
            self.note("info", "devices open: " + ", ".join(run.devices.values()))
        elif event == "safe state":
            run.phase, run.reason, run.reached = "safe", line["reason"], line["reached"]
            run.normal = bool(line["normal"])
            if line["asked_ns"] and line["reached_ns"]:
                run.safe_ms = (line["reached_ns"] - line["asked_ns"]) * 1e-6
            took = f", {run.safe_ms:.0f} ms after it was asked for" if run.safe_ms is not None else ""
            how = run.at_rest if run.reached else "NEUTRAL NOT CONFIRMED: switch the amplifier off"
            self.note("info" if run.reached and run.normal else "error", f"safe state: {run.reason}; {how}{took}")
        else:
            run.status = line
            if run is self.run:
                self._name_hold(line.get("hold"))
            if run.phase == "starting":
                run.phase = "running"

    def _on_end(self, run: Run, outcome: dict[str, Any] | None, failure: str) -> None:
        run.outcome = outcome
        if outcome is not None:
            run.reason = outcome["safe_state"]["reason"]
            run.phase = "safe" if outcome["safe_state"]["reached"] else "ended"
            run.reached, run.normal = outcome["safe_state"]["reached"], outcome["safe_state"]["normal"]
            # counts of the last ticks, too
            run.status |= {"lost": outcome["samples"]["lost"], **outcome.get("kinematics", {})}
            if run is self.run:
                self.holds.name_by_outcome(outcome["holds"])
        else:
            run.phase, run.reason = "failed", failure
            self.note("error", f"the firmware failed: {failure}")

    def _name_hold(self, hold: dict[str, Any] | None) -> None:
        """Take the cause of a hold from the status; a recording that runs gets it as the firmware's own one does."""
        before = self._held_by
        self._held_by = hold["cause"] if hold else ""
        self.holds.name(self._held_by)
        if self.recorder.active and bool(before) != bool(hold):
            name = "hold begins" if hold else "hold ends"
            self.recorder.event(name, self._held_by or before, self.bench_time_ns())

    # -- what people read -----------------------------------------------------------------------------------

    def note(self, level: str, text: str) -> None:
        """A line of the page's log."""
        self.log_number += 1
        self.log.append({"n": self.log_number, "time": time.time(), "level": level, "text": text})

    def stale_s(self) -> float:
        """Return the seconds since the last row."""
        return time.monotonic() - self._fresh_s

    def alerts(self) -> list[dict[str, str]]:
        """Return the alerts as texts, the worst first."""
        run, alerts = self.run, list[tuple[str, str]]()
        if run.phase == "starting":
            alerts.append(("info", "Starting. The first start on a machine compiles, one to three minutes."))
        elif run.phase == "failed":
            alerts.append(("error", self._failure()))
        elif run.phase == "ended":
            alerts.append(("error", f"Neutral was NOT confirmed. Switch the amplifier off. {run.reason}"))
        elif run.phase == "safe":
            kind = "info" if run.normal else "error"
            alerts.append((kind, f"Safe state, {run.at_rest}: {run.reason}."))
        elif run.phase == "running" and self.stale_s() > STALE_S:
            alerts.append(("error", f"Stale data: nothing new from the firmware for {self.stale_s():.1f} s."))
        if ticks := run.status.get("fallbacks", 0):
            alerts.append(("warn", f"Kinematics: {ticks} ticks fell back to the other solution."))
        alerts += self.watch.alerts()
        if self.disk.low:
            alerts.append(("warn", f"Disk nearly full: {self.disk.free_bytes / 1e9:.1f} GB left for recordings."))
        if self.recorder.active and self.recorder.trouble():
            alerts.append(("error", f"Recording: {self.recorder.trouble()}"))
        return [*self._hold_alert(), *({"kind": kind, "text": text} for kind, text in alerts)]

    def _failure(self) -> str:
        """Return the alert for a firmware that ended without an outcome. It depends on whether its outputs were
        driven."""
        if not self.run.status:
            return f"The firmware did not start: {self.run.reason}"
        if not self.run.has_outputs:
            return f"The firmware died: {self.run.reason}. Start it again."
        return (
            f"The firmware died: {self.run.reason}. Nobody confirmed neutral: switch the amplifier off, look at the "
            "tip, then start again."
        )

    def _hold_alert(self) -> list[dict[str, str]]:
        """Return why a hold lasts; with ``order`` where a person may end it."""
        hold = self.run.status.get("hold")
        if self.run.phase != "running" or not hold:
            return []
        text = f"Hold, {self.run.at_rest}: {hold['cause']}."
        if hold["waits_for"] and hold["waits_for"] != hold["cause"]:
            text += f" It waits for {hold['waits_for']}."
        return [{"kind": "warn", "text": text, **({"order": "rearm"} if hold["waits_for"] == OPERATOR else {})}]

    def state(self) -> dict[str, Any]:
        """Return the status message of the page."""
        run, memory = self.run, self.firmware.memory if self.firmware is not None else None
        timing: dict[str, list[float]] = {}
        if memory is not None:
            for index, name in enumerate(run.histograms):
                d = memory.distribution(index)
                timing[name] = [d.n, d.p50_us, d.p99_us, d.p99_9_us, d.max_us, d.max_tick]
        return {
            "type": "state",
            "run": self.run_number,
            "rate_hz": run.rate_hz,
            "bench": self.bench.description.name,
            "bench_file": str(self.choice.bench),
            "emulated": bool(self.bench.description.emulated_buses()),
            "compiled": self.choice.runs_compiled,
            "phase": run.phase,
            "reason": run.reason,
            "safe_ms": run.safe_ms,
            "devices": run.devices,
            "status": run.status,
            "timing": timing,
            "rows": self.history.head,
            "missed_rows": self.missed_rows,
            "stale_s": self.stale_s() if run.phase == "running" else 0.0,
            "alerts": self.alerts(),
            "holds": self.holds.as_list(),
            "disk": {"free": self.disk.free_bytes, "total": self.disk.total_bytes},
            "shadow": self.shadow.method if self.shadow is not None else "",
            "recording": self.recorder.state(),
            "watch": self.watch.state(),
            "log": self.log_number,
        }

    def state_text(self, *, fresh: bool = False) -> str:
        """Return the status message as JSON without its last brace, made once per ``STATUS_S`` for all viewers."""
        now_s = time.monotonic()
        if fresh or now_s - self._state_s >= 0.9 * STATUS_S:
            self._state_s, self._state_text = now_s, json.dumps(self.state(), separators=(",", ":"))[:-1]
        return self._state_text

    def live_buckets(self, channels: NDArray[np.intp], k: int, first: int) -> Buckets:
        """Return what is new of the live data; viewers that ask for the same within one frame share the answer."""
        key = (channels.tobytes(), k, first)
        if key not in self._frame_buckets:
            self._frame_buckets[key] = self.history.buckets(channels, k, first)
        return self._frame_buckets[key]

    def counts(self) -> dict[str, dict[str, list[int]]]:
        """Return the non-empty buckets of every histogram: lower bounds and widths in ns, counts."""
        from firmware_py.scheduler.histogram import bucket_bounds_ns

        firmware = self.firmware
        if firmware is None:
            return {}
        buckets: dict[str, dict[str, list[int]]] = {}
        for index, name in enumerate(self.run.histograms):
            counts = firmware.memory.histogram(index).counts()
            used = np.flatnonzero(counts)
            bounds = [bucket_bounds_ns(int(i)) for i in used]
            buckets[name] = {"ns": [b[0] for b in bounds], "w": [b[1] for b in bounds], "n": counts[used].tolist()}
        return buckets

    # -- rows -----------------------------------------------------------------------------------------------

    async def run_forever(self) -> None:
        """Move rows from the firmware into the history sixty times a second; watch the disk."""
        loop = asyncio.get_running_loop()
        due_s = loop.time()
        disk_s = 0.0
        while True:
            due_s = max(due_s + FRAME_S, loop.time())
            self._take_rows()
            self._frame_buckets.clear()
            ready, self.frame_ready = self.frame_ready, asyncio.Event()
            ready.set()
            if due_s >= disk_s:
                disk_s = due_s + DISK_S
                with contextlib.suppress(OSError):
                    usage = shutil.disk_usage(self.recorder.folder)
                    self.disk = Disk(usage.free, usage.total)
            await asyncio.sleep(max(0.0, due_s - loop.time()))

    def _take_rows(self) -> None:
        if self.firmware is None:
            return
        rows = self.firmware.memory.read(self._row)
        if rows.missed:
            self.missed_rows += rows.missed
            self.note("warn", f"the server was too slow for {rows.missed} rows; the firmware did not wait")
        if len(rows.values):
            self._row = rows.first + len(rows.values)
            self._fresh_s = time.monotonic()
            self.history.append(rows.values)
            t_s = rows.values[:, self.layout.start("t")]
            self.holds.follow(t_s, self.layout.read_holds(self.layout.scalar_names(), rows.values))
            self.targets.follow(rows.values, self.layout)
            if self.recorder.active:
                self.recorder.push(rows)
            if self.shadow is not None:
                self.shadow.follow(rows.values)
            self.watch.take(self.run.status, rows.values)

    def bench_time_ns(self) -> int:
        """Bench time of the newest row, which is emulated time on an emulated bench."""
        status = self.run.status
        if not status:
            return 0
        return status["now_ns"] + round((self.history.latest_t_s - status["t_s"]) * 1e9)

    async def compare(self, method: str) -> None:
        """Run another attitude filter beside the firmware's; an empty name ends that."""
        self.shadow = None
        if method:
            self.shadow = await make_shadow(self.metadata(), method)

    def metadata(self) -> dict[str, Any]:
        """Return the metadata of the running firmware, empty when there is none."""
        return self.firmware.metadata() if self.firmware is not None else {}

    # -- recording ------------------------------------------------------------------------------------------

    async def start_recording(self, name: str, notes: str) -> None:
        """Raises ``RecordingError`` or ``InputError`` when that cannot be."""
        await self.recorder.start(name, notes, self.metadata(), self.layout)
        self.note("info", f"recording {self.recorder.name}")

    async def stop_recording(self) -> dict[str, Any]:
        """Stop the recording and return its result."""
        summary = await self.recorder.stop(self.run.outcome or {})
        level = "error" if summary["problem"] or summary["dropped"] else "info"
        self.note(level, f"recorded {summary['name']}: {summary['ticks']} ticks, {summary['dropped']} dropped")
        return summary
