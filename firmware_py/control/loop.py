"""The instrument's loop: scans in, commands out, one pass a tick, with a supervisor that may stop it.

A tick is due when its scan was taken (device clock). Order within a tick: sense, estimate, actuate, then
everything that can wait. Nothing here knows whether the bench is real.
"""

from __future__ import annotations

import signal
from collections.abc import Callable, Generator
from typing import Any

import numpy as np

from firmware_py.control.config import FirmwareConfig
from firmware_py.control.field_input import FieldInput
from firmware_py.control.incidents import Incidents, LoopCounts, Recorder
from firmware_py.control.manual import ManualDrive
from firmware_py.control.orders import PageOrders
from firmware_py.control.plausibility import ScanCheck, turns_of_pairs
from firmware_py.control.redundancy import Redundancy
from firmware_py.control.safety import FINISHED, State, Supervisor
from firmware_py.control.stages import Stages
from firmware_py.control.status import LoopStatus
from firmware_py.control.tasks import Works, task_table
from firmware_py.control.watch import Watch
from firmware_py.control.wiring import Devices
from firmware_py.frame import (
    CLIP,
    CLIP_YIELD,
    COUNTS,
    STATUS,
    TICK,
    TIME,
    TREMOR_FREQUENCY,
    FrameStatus,
)
from firmware_py.live.link import LiveLink
from firmware_py.scheduler.scheduler import Scheduler
from firmware_py.scheduler.task import BackgroundSpec, TickInfo
from firmware_py.scheduler.ticker import ScanTicker, Ticks
from hal.contracts import Clock
from hal.errors import HalError
from hal.types import ScanBlock, Status, TimeSource

MAX_BLOCK = 1024  # the deepest FIFO of a DAQ: one read empties it
SETTLE_TICKS = 5  # the amplifier's own lag, after the last step of the ramp
LATE_PART = 0.9  # of a period: the prediction bridges a known delay, not this one


class InstrumentLoop:
    """Runs the opened devices. ``on_status`` gets a small dict now and then and must not block. ``sense_only``: nothing
    is armed, and a reading that would end a run is only noticed."""

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
        sense_only: bool = False,
    ) -> None:
        self._live = live
        self._sense_only = sense_only
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
        self._started_ns = 0
        self._last_scan_ns = 0
        self._warned = 0
        self._interrupted = ""
        self.counts = LoopCounts()
        self.supervisor = Supervisor(devices.amplifier)
        self.incidents = Incidents(self.supervisor, self.counts, clock, recorder)
        self.armed_ns: int | None = None
        self.safe_reached_ns: int | None = None
        actuation = stages.configs.actuation
        self.manual = ManualDrive(actuation.low_V, actuation.high_V, actuation.neutral_V)
        self._orders = None
        if live is not None:
            self._orders = PageOrders(live, self.manual, stages, self.supervisor, self.incidents, clock)
        self._field = None
        if devices.magnetometer is not None:
            limit_ms, outlier_V = config.safety.magnetometer_ms, config.plausibility.magnetometer_outlier_V
            self._field = FieldInput(devices.magnetometer, self.incidents, self.counts, limit_ms, outlier_V)
        wired, sensing = devices.sensing_table, stages.configs.sensing
        watched = [*wired["channels"], wired["supply_channel"], wired["temperature_channel"]]
        columns = [column for column in watched if column is not None]
        self._check = ScanCheck(
            config.plausibility, wired["lsb_V"], columns, devices.scan_labels, sensors=len(wired["channels"]),
            mix=turns_of_pairs(sensing.axis_positions(), np.array(sensing.axes)),
        )  # fmt: skip
        self._redundancy = Redundancy(stages, self._check, self.supervisor, self.incidents, devices.scan_labels)
        self._watch = Watch(devices, config, self._frame, self._check, self.supervisor, self.incidents)
        background = [BackgroundSpec("status", self._report_status, 150.0)] if on_status else []
        if live is not None:
            background.append(BackgroundSpec("histograms", lambda: live.show(lambda: self.shown.histograms()), 30.0))
        works = Works(
            sense=self._sense,
            estimate=self._estimate,
            actuate=self._actuate,
            publish=self._publish,
            supervise=self._supervise,
            magnetometer=self._field.poll if self._field is not None else None,
            verify=self._watch.verify_output if devices.verify_output is not None else None,
            monitor=self._watch.monitor_output if devices.monitor is not None else None,
            telemetry=self._send_telemetry if devices.telemetry is not None else None,
        )
        tasks = task_table(works, tick_hz, config.budget_us, devices.polling, devices.bus_us)
        self.scheduler = Scheduler(tasks, clock, period_ns=self._period_ns, background=background)
        self.shown = LoopStatus(
            stages, self.counts, self.supervisor, self.manual, self.scheduler, clock, for_page=live is not None
        )

    @property
    def error(self) -> HalError | None:
        """The hardware error that ended the run, if one did."""
        return self.incidents.error

    @property
    def asked_safe_ns(self) -> int | None:
        """When the page asked for the safe state."""
        return self._orders.asked_safe_ns if self._orders is not None else None

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
            self.incidents.error = error
            self.incidents.trip(f"{error}")
        except BaseException as error:
            self.incidents.trip(f"{type(error).__name__}: {error}")
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
        if self._sense_only:
            self.supervisor.begin_sensing()
        else:
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
        while self.supervisor.state is not State.SAFE and not self.supervisor.must_not_wait:
            ticks = ticker.wait()
            self._ticks = ticks
            self.incidents.tick = ticks.k0
            if ticks.n > 1:
                self.incidents.notice("scans came late")
                if ticks.n * ticks.dt_ns > limits.stalled_ms * 1e6:
                    self.incidents.trip(
                        f"the host stood still: {ticks.n} scans of {self._devices.daq.name} came at once"
                    )
            newest_ns = ticks.due_ns + (ticks.n - 1) * ticks.dt_ns
            if ticks.source is TimeSource.HOST:
                self.incidents.trip(f"{self._devices.daq.name}: no new scan for {limits.stale_ms:g} ms; check its link")
            elif self._interrupted:
                self.incidents.trip(f"stopped by the operator ({self._interrupted})", normal=True)
            elif end_ns is not None and newest_ns >= end_ns:
                self.incidents.trip(FINISHED, normal=True)
            elif end_ns is None and self._sense_only:
                end_ns = newest_ns + round(seconds * 1e9)
            self.scheduler.run(ticks)
            if self.supervisor.state is State.SELF_TEST and self._watch.self_test_passed(
                (newest_ns - self._started_ns) * 1e-6
            ):
                self.scheduler.ignore_next("arming")
                self.supervisor.arm()
                self.armed_ns = self._clock.now_ns()
                end_ns = self.armed_ns + round(seconds * 1e9)
            self.scheduler.run_slack(newest_ns + ticks.dt_ns + self._period_ns)

    def _read(self, timeout_s: float) -> ScanBlock:
        try:
            block = self._devices.daq.read_scans(self._rows, timeout_s)
        except HalError as error:
            self.incidents.trip_for(self._devices.daq.name, error)
            raise
        self._block = block
        if block.n:
            self._last_scan_ns = block.t0_ns + (block.n - 1) * block.dt_ns
            if block.status & Status.SHIFTED:
                self.incidents.notice(f"scans of {self._devices.daq.name} come at another time than their clock says")
        self.counts.received += block.n
        if block.lost:
            self.incidents.notice("scans were lost")
            self.counts.lost += block.lost
        self.counts.expected += block.n + block.lost
        return block

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
                self.incidents.error = self.error or (None if self.supervisor.safe_reached else error)

    # -- tasks --------------------------------------------------------------------------------------------

    def _sense(self, info: TickInfo) -> None:
        frame, block, ticks = self._frame, self._block, self._ticks
        assert block is not None
        assert ticks is not None
        frame[TICK] = self.incidents.tick = info.k
        frame[TIME] = (info.due_ns - self._started_ns) * 1e-9
        if block.n == 0:
            frame[STATUS] = FrameStatus.STALE
        else:
            row = info.k - ticks.k0
            frame[STATUS] = FrameStatus.GAP if block.lost and row == 0 else 0
            scan = self._rows[row]
            frame[COUNTS : COUNTS + self._rows.shape[1]] = scan
            impossible = self._check.scan(scan, info.k)
            if impossible and (impossible := self._redundancy.impossible(self._check.channel, impossible)):
                self.incidents.doubt("an input read something impossible", impossible)
        if self._field is not None:
            self._field.fill(frame)

    def _estimate(self, info: TickInfo) -> None:
        """The whole step in one compiled call; of scans that came late only the newest is commanded."""
        assert self._ticks is not None
        if self.supervisor.may_move and info.k == self._ticks.k0 + self._ticks.n - 1:
            if self.manual.active:
                self.stages.follow(self.manual.step(self._clock.now_ns()))
            else:
                self.stages.command()
        self.stages.step()
        bits = int(self._frame[STATUS])
        # before the command goes out: a sensor that contradicts its twin must not move anything
        if self._redundancy.there:
            if unclear := self._redundancy.agree(self._frame):
                self.incidents.doubt("axes contradict each other", unclear)
        elif not bits & (FrameStatus.INVALID | FrameStatus.STALE) and (apart := self._check.pairs(self._frame)):
            self.incidents.doubt("parallel axes disagree", apart)
        status = bits & (FrameStatus.JERK | FrameStatus.DRIFT)
        if status != self._warned:
            for bit, what in ((FrameStatus.JERK, "jerk"), (FrameStatus.DRIFT, "drift")):
                if status & ~self._warned & bit:
                    self.supervisor.warn(what)
                    self.incidents.note({"event": what})
            self._warned = status

    def _actuate(self, info: TickInfo) -> None:
        if self.supervisor.may_move:
            amplifier = self._devices.amplifier
            sent = amplifier.commands_sent
            try:
                clipped = amplifier.write(self.stages.command_V)
            except HalError as error:
                self.incidents.error = error
                self.incidents.trip_for(amplifier.name, error)
                return
            self.counts.clipped += bool(clipped != 0 or int(self._frame[CLIP]) & ~CLIP_YIELD)
            if amplifier.commands_sent == sent:
                self.counts.superseded += 1
                return
            latency_ns = self._clock.now_ns() - info.due_ns
            if latency_ns > LATE_PART * self._period_ns:
                self.incidents.notice("commands were late")
            self.counts.latency.add(latency_ns, info.k)
            self.counts.commands += 1
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

    def _supervise(self, info: TickInfo) -> None:
        """100 Hz: the page's orders, then everything that may end the run and is not seen by the task that needs it."""
        if self._orders is not None:
            self._orders.obey_all()
        self._watch.supervise(info)

    def _send_telemetry(self, info: TickInfo) -> None:
        telemetry = self._devices.telemetry
        assert telemetry is not None
        frame, state = self._frame, int(self.supervisor.state)
        telemetry.heartbeat.state = state
        telemetry.send_tremor(self.shown.amplitude_um(), float(frame[TREMOR_FREQUENCY]))
        scheduler = self.scheduler
        telemetry.send_state(
            state, int(frame[STATUS]), self.counts.lost, scheduler.skipped_ticks, scheduler.worst_tick_ns * 1e-3
        )

    def _report_status(self) -> Generator[bool, None, None]:
        assert self._on_status is not None
        every = 200_000_000 // self._period_ns
        next_k = 0
        while True:
            k = self._ticks.k0 if self._ticks is not None else 0
            if k >= next_k:
                next_k = k + every
                self._on_status(self.shown.numbers())
            yield False
