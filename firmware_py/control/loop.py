"""The instrument's loop: scans in, commands out, one pass a tick, with a supervisor that may stop it.

A tick is due when its scan was taken (device clock). Order within a tick: sense, estimate, actuate, then
everything that can wait. Nothing here knows whether the bench is real.
"""

from __future__ import annotations

import signal
from collections.abc import Callable, Generator, Mapping
from dataclasses import dataclass, field
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from firmware_py.control.config import FirmwareConfig
from firmware_py.control.manual import ManualDrive
from firmware_py.control.plausibility import ScanCheck
from firmware_py.control.safety import State, Supervisor
from firmware_py.control.stages import Stages
from firmware_py.control.wiring import Devices
from firmware_py.frame import (
    CLIP,
    COMMAND,
    COUNTS,
    MAGNETOMETER_FRESH,
    MAGNETOMETER_RAW,
    STATUS,
    SUPPLY,
    TEMPERATURE,
    TICK,
    TIME,
    TREMOR_AMPLITUDE,
    TREMOR_FREQUENCY,
    FrameStatus,
)
from firmware_py.live.link import LiveLink
from firmware_py.scheduler.histogram import DurationHistogram
from firmware_py.scheduler.scheduler import Scheduler
from firmware_py.scheduler.task import BackgroundSpec, TaskSpec, TickInfo
from firmware_py.scheduler.ticker import ScanTicker, Ticks
from hal.contracts import Clock
from hal.errors import HalError
from hal.types import ScanBlock, TimeSource

MAX_BLOCK = 1024  # the deepest FIFO of a DAQ: one read empties it
SETTLE_TICKS = 5  # the amplifier's own lag, after the last step of the ramp
LATE_PART = 0.9  # of a period: the prediction bridges a known delay, not this one
BUDGETS_US = {
    "sense": 60.0,
    "estimate": 30.0,
    "actuate": 520.0,  # 390 us of bus time at 400 kHz
    "publish": 30.0,
    "magnetometer": 350.0,  # 220 us of bus time
    "supervise": 300.0,
    "telemetry": 300.0,
    "verify": 340.0,  # 260 us of bus time
}
VERIFY_PHASES = (1, 4, 8)


class Recorder(Protocol):
    """Where finished frames go; never blocks, counts what it drops."""

    def push(self, row: NDArray[np.float64]) -> bool: ...
    def event(self, event: dict[str, object]) -> bool: ...


@dataclass
class LoopCounts:
    """What the loop counted besides the scheduler's figures.

    ``lost``: scans known to be missing; ``unread``: scans that were due after the last
    one read, when the loop stopped.
    ``clipped``: commands that ran into a limit. ``noticed``: bench time at which something that does not end a run
    was first seen.
    """

    expected: int = 0
    received: int = 0
    lost: int = 0
    unread: int = 0
    commands: int = 0
    clipped: int = 0
    magnetometer_errors: int = 0
    noticed: dict[str, int] = field(default_factory=dict[str, int])
    latency: DurationHistogram = field(default_factory=DurationHistogram)


class InstrumentLoop:
    """Runs the opened devices. ``on_status`` gets a small dict now and then and must not block."""

    def __init__(
        self,
        devices: Devices,
        stages: Stages,
        config: FirmwareConfig,
        clock: Clock,
        *,
        tick_hz: int,
        recorder: Recorder | None = None,
        on_status: Callable[[dict[str, object]], None] | None = None,
        live: LiveLink | None = None,
    ) -> None:
        self._live = live
        self._devices = devices
        self.stages = stages
        self._frame = stages.frame
        self._config = config
        self._clock = clock
        self._period_ns = 1_000_000_000 // tick_hz
        self._recorder = recorder
        self._on_status = on_status
        self._rows = np.zeros((MAX_BLOCK, len(devices.scan.channels)), dtype=np.int16)
        self._block: ScanBlock | None = None
        self._ticks: Ticks | None = None
        self._field_V = np.zeros(3)
        self._field_fresh = False
        self._field_hangs = False
        self._started_ns = 0
        self._last_scan_ns = 0
        self._bad_since: dict[str, int] = {}
        self._warned = 0
        self._interrupted = ""
        wired = devices.sensing_table
        watched = (*wired["channels"], wired["supply_channel"], wired["temperature_channel"])
        self._check = ScanCheck(config.plausibility, wired["lsb_V"], watched, devices.scan_labels)
        self.supervisor = Supervisor(devices.amplifier)
        self.counts = LoopCounts()
        self.error: HalError | None = None
        self.armed_ns: int | None = None
        self.asked_safe_ns: int | None = None
        self.safe_reached_ns: int | None = None
        actuation = stages.configs.actuation
        self.manual = ManualDrive(actuation.low_V, actuation.high_V, actuation.neutral_V)
        background = [BackgroundSpec("status", self._report_status, 150.0)] if on_status else []
        if live is not None:
            background.append(BackgroundSpec("histograms", lambda: live.show(self.histograms), 30.0))
        self.scheduler = Scheduler(self._task_table(tick_hz), clock, period_ns=self._period_ns, background=background)

    # -- tables -------------------------------------------------------------------------------------------

    def _task_table(self, tick_hz: int) -> list[TaskSpec]:
        budget = {**BUDGETS_US, **self._config.budget_us}
        period_us = 1e6 / tick_hz

        def task(
            name: str,
            fn: Callable[[TickInfo], object],
            order: int,
            divider: int = 1,
            phase: int = 0,
            *,
            catch_up: bool = False,
            budget_of: str = "",
        ) -> TaskSpec:
            return TaskSpec(name, fn, divider, phase, order, budget[budget_of or name], period_us, catch_up)

        table = [
            task("sense", self._sense, 0, catch_up=True),
            task("estimate", self._estimate, 1, catch_up=True),
            task("actuate", self._actuate, 2),
            task("publish", self._publish, 3, catch_up=True),
            task("supervise", self._supervise, 5, 10, 2),
        ]
        if self._devices.magnetometer is not None:
            for axis, phase in zip("xyz", (0, 3, 6), strict=True):
                table.append(
                    task(f"magnetometer_{axis}", self._poll_magnetometer, 4, 10, phase, budget_of="magnetometer")
                )
        if self._devices.verify_output is not None:
            # in ticks that leave the bus free for it
            for phase in VERIFY_PHASES:
                table.append(task(f"verify_{phase}", self._verify_output, 4, 10, phase, budget_of="verify"))
        if self._devices.telemetry is not None:
            table.append(task("telemetry", self._send_telemetry, 6, 20, 5))
        return table

    # -- running ------------------------------------------------------------------------------------------

    def run(self, seconds: float) -> None:
        """Self-test, arm, run for ``seconds`` after arming, ramp to neutral. Always ends in the safe state.

        A hardware error becomes the reason of the trip and is kept in ``error``; anything else is raised
        again after the ramp.
        """
        previous = self._catch_signals()
        try:
            self._start()
            self._run_ticks(seconds)
        except HalError as error:
            self.error = error
            self._trip(f"{error}")
        except BaseException as error:
            self._trip(f"{type(error).__name__}: {error}")
            raise
        finally:
            self._ramp_without_scans()
            self._tell_end()
            self._stop()
            self._count_unread()
            for number, handler in previous.items():
                signal.signal(number, handler)

    def _catch_signals(self) -> dict[signal.Signals, Any]:
        def interrupt(number: int, _frame: object) -> None:
            self._interrupted = signal.Signals(number).name

        try:
            return {s: signal.signal(s, interrupt) for s in (signal.SIGINT, signal.SIGTERM)}
        except ValueError:  # not the main thread: whoever started the loop there handles signals
            return {}

    def _start(self) -> None:
        self.supervisor.begin_self_test()
        self._started_ns = self._clock.now_ns()
        self._devices.daq.start()

    def _run_ticks(self, seconds: float) -> None:
        limits = self._config.safety
        ticker = ScanTicker(
            self._read,
            self._clock,
            self._period_ns,
            silent_after_ns=round(limits.stale_ms * 1e6),
        )
        end_ns: int | None = None
        while self.supervisor.state is not State.SAFE:
            ticks = ticker.wait()
            self._ticks = ticks
            if ticks.n > 1:
                self._notice("scans came late")
                if ticks.n * ticks.dt_ns > limits.stalled_ms * 1e6:
                    self._trip(f"the host stood still: {ticks.n} scans of {self._devices.daq.name} came at once")
            newest_ns = ticks.due_ns + (ticks.n - 1) * ticks.dt_ns
            if ticks.source is TimeSource.HOST:
                self._trip(f"{self._devices.daq.name}: no new scan for {limits.stale_ms:g} ms; check its link")
            elif self._interrupted:
                self._trip(f"stopped by the operator ({self._interrupted})", normal=True)
            elif end_ns is not None and newest_ns >= end_ns:
                self._trip("run finished", normal=True)
            self.scheduler.run(ticks)
            if self.supervisor.state is State.SELF_TEST and self._self_test_passed(newest_ns):
                self.scheduler.ignore_next("arming")
                self.supervisor.arm()
                self.armed_ns = self._clock.now_ns()
                end_ns = self.armed_ns + round(seconds * 1e9)
            self.scheduler.run_slack(newest_ns + ticks.dt_ns + self._period_ns)

    def _read(self, timeout_s: float) -> ScanBlock:
        try:
            block = self._devices.daq.read_scans(self._rows, timeout_s)
        except HalError as error:
            self._trip_for(self._devices.daq.name, error)
            raise
        self._block = block
        if block.n:
            self._last_scan_ns = block.t0_ns + (block.n - 1) * block.dt_ns
        self.counts.received += block.n
        if block.lost:
            self._notice("scans were lost")
            self.counts.lost += block.lost
        self.counts.expected += block.n + block.lost
        return block

    def _notice(self, what: str) -> None:
        self.counts.noticed.setdefault(what, self._clock.now_ns())

    def _count_unread(self) -> None:
        """Scans that the device has had time for since the last one that was read."""
        if self._last_scan_ns:
            self.counts.unread = max(0, (self._clock.now_ns() - self._last_scan_ns) // self._period_ns)

    def _ramp_without_scans(self) -> None:
        """Finish the ramp on the host clock (the loop, or what drove it, may be gone) and let the outputs settle."""
        while self.supervisor.state is State.SAFE_RAMP:
            due_ns = self._clock.now_ns() + self._period_ns
            if self.supervisor.step():
                self._note_safe()
            self._clock.sleep_until_ns(due_ns)
        self._clock.sleep_until_ns(self._clock.now_ns() + SETTLE_TICKS * self._period_ns)

    def _tell_end(self) -> None:
        """The bench page need not wait for the outcome to know that the outputs are safe."""
        trip = self.supervisor.trip_cause
        if self._live is not None and self._on_status is not None and trip is not None:
            self._on_status(
                {
                    "event": "safe state",
                    "reason": trip.reason,
                    "normal": trip.normal,
                    "reached": self.supervisor.safe_reached,
                    "asked_ns": self.asked_safe_ns,
                    "tripped_ns": trip.t_ns,
                    "reached_ns": self.safe_reached_ns,
                }
            )

    def _stop(self) -> None:
        for close in (self._devices.daq.stop, self._devices.amplifier.close):
            try:
                close()
            except HalError as error:
                # the link may be what failed: the first error is the one to tell
                self.error = self.error or (None if self.supervisor.safe_reached else error)

    def _trip(self, reason: str, *, normal: bool = False) -> None:
        if self.supervisor.trip_cause is not None:
            return
        tick = self._ticks.k0 if self._ticks is not None else -1
        t_ns = self._clock.now_ns()
        self.supervisor.trip(reason, tick=tick, t_ns=t_ns, normal=normal)
        if self._recorder is not None:
            self._recorder.event({"t_ns": t_ns, "tick": tick, "event": "safe state", "reason": reason})

    def _trip_for(self, device: str, error: HalError) -> None:
        """Trip with the bench's name of the device in front: a port knows only its path."""
        self._trip(f"{error}" if str(error).startswith(device) else f"{device}: {error}")

    # -- tasks --------------------------------------------------------------------------------------------

    def _sense(self, info: TickInfo) -> None:
        frame, block, ticks = self._frame, self._block, self._ticks
        assert block is not None
        assert ticks is not None
        frame[TICK] = info.k
        frame[TIME] = (info.due_ns - self._started_ns) * 1e-9
        if block.n == 0:
            frame[STATUS] = FrameStatus.STALE
        else:
            row = info.k - ticks.k0
            frame[STATUS] = FrameStatus.GAP if block.lost and row == 0 else 0
            scan = self._rows[row]
            frame[COUNTS : COUNTS + self._rows.shape[1]] = scan
            if impossible := self._check.scan(scan, info.k):
                self._trip(impossible)
        frame[MAGNETOMETER_FRESH] = float(self._field_fresh)
        if self._field_fresh:
            frame[MAGNETOMETER_RAW : MAGNETOMETER_RAW + 3] = self._field_V
            self._field_fresh = False
        self.stages.sense()

    def _estimate(self, info: TickInfo) -> None:
        self.stages.estimate()
        status = int(self._frame[STATUS]) & (FrameStatus.JERK | FrameStatus.DRIFT)
        if status != self._warned:
            for bit, what in ((FrameStatus.JERK, "jerk"), (FrameStatus.DRIFT, "drift")):
                if status & ~self._warned & bit:
                    self.supervisor.warn(what)
                    self._note({"event": what})
            self._warned = status

    def _actuate(self, info: TickInfo) -> None:
        if self.supervisor.may_move:
            if self.manual.active:
                self.stages.command_V[:] = self.manual.step(self._clock.now_ns())
                self.stages.follow()
            else:
                self.stages.actuate()
            try:
                clipped = self._devices.amplifier.write(self.stages.command_V)
            except HalError as error:
                self.error = error
                self._trip_for(self._devices.amplifier.name, error)
                return
            latency_ns = self._clock.now_ns() - info.due_ns
            if latency_ns > LATE_PART * self._period_ns:
                self._notice("commands were late")
            self.counts.latency.add(latency_ns, info.k)
            self.counts.commands += 1
            self.counts.clipped += bool(clipped != 0 or self._frame[CLIP] != 0)
        elif self.supervisor.step():
            self._note_safe()

    def _note_safe(self) -> None:
        if self.safe_reached_ns is None:
            self.safe_reached_ns = self._clock.now_ns()

    def _publish(self, info: TickInfo) -> None:
        if self._live is not None:
            self._live.publish(self._frame)
        if self._recorder is not None:
            self._recorder.push(self._frame)

    def _poll_magnetometer(self, info: TickInfo) -> None:
        magnetometer = self._devices.magnetometer
        assert magnetometer is not None
        try:
            if magnetometer.poll():
                volts = magnetometer.volts
                # three axes never read the same twice; one converter that hangs gives its last word for all
                hangs = bool(volts[0] == volts[1] == volts[2])
                if hangs and self._field_hangs:
                    self._notice("magnetometer's converter hangs")
                self._field_hangs = hangs
                self._field_V[:] = volts
                self._field_fresh = not hangs
            self._bad_for(
                "magnetometer",
                self._field_hangs,
                info.due_ns,
                self._config.safety.magnetometer_ms,
                f"{magnetometer.name}: its converter gives one reading for all axes; it hangs",
            )
        except HalError as error:
            self.counts.magnetometer_errors += 1
            self._notice("magnetometer does not answer")
            self._bad_for("magnetometer", True, info.due_ns, self._config.safety.magnetometer_ms, str(error))

    def _supervise(self, info: TickInfo) -> None:
        """100 Hz: everything that may end the run and is not seen by the task that needs it."""
        if self._live is not None:
            for order in self._live.orders():
                self._obey(order)
        frame, limits = self._frame, self._config.safety
        status = int(frame[STATUS])
        t_ns = info.due_ns
        if status & FrameStatus.INVALID:
            self._trip("a reading or estimate is not a number; see the recording")
        self._bad_for(
            "saturation",
            bool(status & FrameStatus.SATURATED),
            t_ns,
            limits.saturated_ms,
            f"an accelerometer has been beyond its range for {limits.saturated_ms:g} ms; is the instrument falling?",
        )
        for name, value, unit, (lo, hi) in (
            ("temperature", frame[TEMPERATURE], "degC", limits.temperature_C),
            ("supply", frame[SUPPLY], "V", limits.supply_V),
        ):
            outside = not lo <= value <= hi and not status & FrameStatus.ALIGNING
            self._bad_for(name, outside, t_ns, 100.0, f"{name} {value:.2f} {unit} is outside {lo:g}..{hi:g} {unit}")
        if not status & FrameStatus.INVALID and (apart := self._check.pairs(frame, 0.01)):
            self._trip(apart)
        telemetry = self._devices.telemetry
        if telemetry is not None:
            if telemetry.poll():
                self._trip("stop button pressed")
            elif telemetry.button_silent() and self.supervisor.may_move:
                self._trip(f"{telemetry.name}: the stop button is not heard any more; check the CAN bus and the button")

    def _obey(self, order: Mapping[str, Any]) -> None:
        """An order of the bench page; one that makes no sense is dropped."""
        now_ns = self._clock.now_ns()
        match order:
            case {"order": "safe"}:
                asked_ns = order.get("t_ns")
                self.asked_safe_ns = asked_ns if isinstance(asked_ns, int) else now_ns
                self._trip("stopped by the operator (safe button of the bench page)", normal=True)
            case {"order": "arm"} if self.supervisor.may_move:
                self.manual.arm(now_ns, self.stages.command_V)
            case {"order": "disarm"}:
                self.manual.disarm()
            case {"order": "jog", "channel": int(channel), "rate_V_per_s": float(rate) | int(rate)}:
                self.manual.jog(now_ns, channel, float(rate))
            case {"order": "gain", "value": float(gain) | int(gain)} if 0.0 <= gain <= 1.5:
                self.stages.actuation.params["gain"] = float(gain)
                self._note({"event": "compensation gain", "value": float(gain)})
            case _:
                return

    def _note(self, event: dict[str, object]) -> None:
        if self._recorder is not None:
            self._recorder.event({"t_ns": self._clock.now_ns(), "tick": int(self._frame[TICK]), **event})

    def _verify_output(self, info: TickInfo) -> None:
        """300 Hz: the amplifier must hold what it was told; a DAC that restarted or misheard does not."""
        assert self._devices.verify_output is not None
        if not self.supervisor.may_move:
            return
        name = self._devices.amplifier.name
        try:
            if wrong := self._devices.verify_output():
                self._trip(f"{name}: {wrong}; check its supply and the bus")
        except HalError as error:
            self.error = error
            self._trip_for(name, error)

    def _bad_for(self, what: str, bad: bool, t_ns: int, limit_ms: float, reason: str) -> None:
        """Trip when ``bad`` has held for ``limit_ms``."""
        if not bad:
            self._bad_since.pop(what, None)
        elif (t_ns - self._bad_since.setdefault(what, t_ns)) * 1e-6 >= limit_ms:
            self._trip(reason)

    def _send_telemetry(self, info: TickInfo) -> None:
        telemetry = self._devices.telemetry
        assert telemetry is not None
        frame, state = self._frame, int(self.supervisor.state)
        telemetry.heartbeat.state = state
        amplitude_um = [1e6 * float(v) for v in frame[TREMOR_AMPLITUDE : TREMOR_AMPLITUDE + 3]]
        telemetry.send_tremor(amplitude_um, float(frame[TREMOR_FREQUENCY]))
        scheduler = self.scheduler
        telemetry.send_state(
            state, int(frame[STATUS]), self.counts.lost, scheduler.skipped_ticks, scheduler.worst_tick_ns * 1e-3
        )

    def _self_test_passed(self, now_ns: int) -> bool:
        """Sensors have been watched long enough and are sane; trips when that takes too long."""
        limits = self._config.self_test
        watched_ms = (now_ns - self._started_ns) * 1e-6
        status = int(self._frame[STATUS])
        telemetry = self._devices.telemetry
        waiting = [
            name
            for name, wrong in (
                ("attitude is not aligned", status & FrameStatus.ALIGNING),
                ("an accelerometer is out of range", status & FrameStatus.SATURATED),
                ("a reading is not a number", status & FrameStatus.INVALID),
                ("the stop button has not been heard", telemetry is not None and telemetry.button_silent()),
            )
            if wrong
        ]
        if not waiting:
            return watched_ms >= limits.watch_ms
        if watched_ms > limits.limit_ms:
            self._trip(f"self-test: {', '.join(waiting)} after {limits.limit_ms:g} ms")
        return False

    def _report_status(self) -> Generator[bool, None, None]:
        assert self._on_status is not None
        every = 200_000_000 // self._period_ns
        next_k = 0
        while True:
            k = self._ticks.k0 if self._ticks is not None else 0
            if k >= next_k:
                next_k = k + every
                self._on_status(self.status())
            yield False

    def histograms(self) -> dict[str, DurationHistogram]:
        """Every live histogram, sample to command first."""
        return {"sample to command": self.counts.latency, **self.scheduler.histograms()}

    def status(self) -> dict[str, object]:
        """A few numbers for the eye."""
        frame = self._frame
        latency = self.counts.latency.distribution()
        bench: dict[str, object] = {}
        if self._live is not None:
            now_ns = self._clock.now_ns()
            trip = self.supervisor.trip_cause
            bench = {
                "now_ns": now_ns,
                "reason": trip.reason if trip is not None else "",
                "manual": "armed" if self.manual.armed(now_ns) else "returning" if self.manual.active else "off",
                "gain": float(self.stages.actuation.params["gain"][0]),
                "samples": self.counts.received,
                "commands": self.counts.commands,
                "clipped": self.counts.clipped,
                "magnetometer_errors": self.counts.magnetometer_errors,
                "tasks": self.scheduler.task_counts(),
            }
        return {
            **bench,
            "t_s": float(frame[TIME]),
            "state": self.supervisor.state.name.lower().replace("_", " "),
            "amplitude_um": [1e6 * float(v) for v in frame[TREMOR_AMPLITUDE : TREMOR_AMPLITUDE + 3]],
            "frequency_hz": [float(v) for v in frame[TREMOR_FREQUENCY : TREMOR_FREQUENCY + 3]],
            "command_V": [float(v) for v in frame[COMMAND : COMMAND + 3]],
            "latency_us": [latency.p50_us, latency.p99_us],
            "lost": self.counts.lost,
            "skipped": self.scheduler.skipped_ticks,
        }
