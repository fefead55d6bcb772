"""Runs the instrument's loop: one pass per tick turns a scan into a command; a supervisor may stop it.

A tick is due when its scan was taken (device clock). A tick runs sense, estimate and actuate first, then
everything that can wait. Nothing here knows whether the bench is real.
"""

from __future__ import annotations

import signal
from collections.abc import Callable, Generator
from typing import Any

import numpy as np

from firmware_py.control.config import FirmwareConfig
from firmware_py.control.field_input import FieldInput
from firmware_py.control.manual import ManualDrive
from firmware_py.control.orders import PageOrders
from firmware_py.control.plausibility import ScanCheck, turns_of_pairs
from firmware_py.control.redundancy import Redundancy
from firmware_py.control.scan_input import ScanInput
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
from firmware_py.run.findings import Finding, finding_of_button, finding_of_output
from firmware_py.run.incidents import Incidents, LoopCounts, Recorder
from firmware_py.run.safety import State, Supervisor
from firmware_py.scheduler.scheduler import Scheduler
from firmware_py.scheduler.task import BackgroundSpec, TickInfo
from firmware_py.scheduler.ticker import ScanTicker, Ticks
from hal.contracts import Clock
from hal.errors import HalError

SETTLE_TICKS = 5  # covers the amplifier's own lag after the last step of the ramp
LONGEST_PAUSE_NS = 10_000_000
"""Longest pause between two attempts at a ramp step over a failing bus. The pauses double up to this value."""
LATE_PART = 0.9  # latency of a late command, in periods; the prediction bridges a known delay, which this exceeds


class InstrumentLoop:
    """Runs the opened devices. ``on_status`` gets a small dict now and then and must not block. ``sense_only``: nothing
    is armed, and a reading that would end a run is only noticed. ``others_stalled_ms(now_ns, within_ms)`` tells how
    long another process of this host, which answers for devices, stands or stood still."""

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
        others_stalled_ms: Callable[[int, float], float] | None = None,
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
        self._ticks: Ticks | None = None
        self._end_ns: int | None = None
        self._started_ns = 0
        self._disturbed_ns = 0
        self._warned = 0
        self._interrupted = ""
        self._interrupts = 0
        self._is_told_to_give_up = False
        self.counts = LoopCounts()
        self.supervisor = Supervisor(devices.amplifier)
        self.incidents = Incidents(self.supervisor, self.counts, clock, recorder, config.safety)
        self.holds = self.incidents.holds
        self.scans = ScanInput(
            devices, config.safety, clock, self._period_ns, self.counts, self.supervisor, self.incidents,
            others_stalled_ms,
        )  # fmt: skip
        self._rearm_signalled = False
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
            stages, self.counts, self.supervisor, self.holds, self.manual, self.scheduler, clock,
            for_page=live is not None,
        )  # fmt: skip

    @property
    def error(self) -> HalError | None:
        """Return the hardware error that ended the run, or ``None``."""
        return self.incidents.error

    @property
    def asked_safe_ns(self) -> int | None:
        """Return the bench time (ns) at which the page asked for the safe state, or ``None``."""
        return self._orders.asked_safe_ns if self._orders is not None else None

    def list_holds(self) -> list[dict[str, Any]]:
        """Return every hold of the run, as its JSON has them."""
        return self.holds.as_list(self._started_ns, self._clock.now_ns())

    def describe(self) -> dict[str, Any]:
        """Return, as JSON values, what ran the ticks."""
        return {"kind": "python"}

    # -- running ------------------------------------------------------------------------------------------

    def run(self, seconds: float) -> None:
        """Run the self-test, arm, run for ``seconds`` after arming, ramp to neutral. Always ends in the safe state.

        A hardware error becomes the reason of the trip and is kept in ``error``; anything else is raised
        again after the ramp.
        """
        previous = self._catch_signals()
        try:
            self._start()
            self._run_ticks(seconds)
        except HalError as error:
            self.incidents.error = error
            self.incidents.report(Finding.DEVICE_FAILED, error=error)
        except BaseException as error:
            self.incidents.report(Finding.FIRMWARE_FAILED, error=f"{type(error).__name__}: {error}")
            raise
        finally:
            self._ramp_without_scans()
            self._tell_end()
            self._stop()
            self.scans.count_unread()
            for number, handler in previous.items():
                signal.signal(number, handler)

    def _catch_signals(self) -> dict[signal.Signals, Any]:
        def interrupt(number: int, _frame: object) -> None:
            self._interrupted = signal.Signals(number).name
            self._interrupts += 1

        def rearm(number: int, _frame: object) -> None:
            self._rearm_signalled = True

        try:
            previous = {s: signal.signal(s, interrupt) for s in (signal.SIGINT, signal.SIGTERM)}
            return {**previous, signal.SIGUSR1: signal.signal(signal.SIGUSR1, rearm)}
        except ValueError:  # not the main thread: whoever started the loop there handles signals
            return {}

    def _start(self) -> None:
        if self._sense_only:
            self.supervisor.begin_sensing()
        else:
            self.supervisor.begin_self_test()
        self._started_ns = self._clock.now_ns()
        self.scans.start()

    def _run_ticks(self, seconds: float) -> None:
        limits = self._config.safety
        ticker = ScanTicker(
            self.scans.read,
            self._clock,
            self._period_ns,
            silent_after_ns=round(limits.stale_ms * 1e6),
        )
        while self.supervisor.state is not State.SAFE and not self.supervisor.must_not_wait:
            if (ticks := self._wait(ticker)) is None:
                continue
            awake_ns = self._clock.now_ns()
            self._ticks = ticks
            self.incidents.tick = ticks.k0
            newest_ns = ticks.due_ns + (ticks.n - 1) * ticks.dt_ns
            self.scans.look_at(ticks)
            if self._interrupted:
                self.incidents.report(Finding.STOPPED, signal=self._interrupted)
            elif self._end_ns is not None and newest_ns >= self._end_ns and self._may_finish():
                self.incidents.report(Finding.FINISHED)
            elif self._end_ns is None and self._sense_only:
                self._end_ns = newest_ns + round(seconds * 1e9)
            self.scheduler.run(ticks)
            self.scans.host_gaps.look(awake_ns + self._period_ns, self._clock.now_ns())
            if self.supervisor.state is State.SELF_TEST and self._self_test_passed():
                self._arm()
                if self.armed_ns is not None:
                    self._end_ns = self.armed_ns + round(seconds * 1e9)
            elif self.supervisor.is_holding:
                self._look_after_hold()
            self.scheduler.run_slack(newest_ns + ticks.dt_ns + self._period_ns)

    def _wait(self, ticker: ScanTicker) -> Ticks | None:
        """Return the next ticks; a loop that ran some by itself returns None where it must not wait any more. A failed
        scan is reported, and the host clock drives the loop until it runs again."""
        try:
            return ticker.wait()
        except HalError:
            if self.supervisor.trip_cause is not None:
                raise
        self.scans.take_none(self._clock.now_ns())
        return ticker.tick_without_scan()

    def _self_test_passed(self) -> bool:
        if self.scans.failed:
            self.scans.restart()
        now_ns = self._clock.now_ns()
        self._watch.restore_guardian(now_ns)
        if self.scans.host_stalled_ms():
            self._disturbed_ns = now_ns
        since_start_ms = (now_ns - self._started_ns) * 1e-6
        watched_ms = min(since_start_ms, self.holds.good_ms(now_ns))
        return self._watch.self_test_passed(watched_ms, since_start_ms, (now_ns - self._disturbed_ns) * 1e-6)

    def _arm(self) -> None:
        self.scheduler.ignore_next("arming")
        try:
            self.supervisor.arm()
        except HalError as error:  # the port that failed does not know whose it is
            self.incidents.report_error(Finding.OUTPUT_FAILED, self._devices.amplifier.name, error)
        else:
            self.armed_ns = self._clock.now_ns()

    def _may_finish(self) -> bool:
        """Return False within a hold whose cause has not passed: an end of the run there would hide the cause."""
        return not self.supervisor.is_holding or self.holds.is_ready

    def _look_after_hold(self) -> None:
        """End the hold, wait, or give it up, while the outputs are on their way to neutral or there."""
        now_ns = self._clock.now_ns()
        self.manual.stop()
        if self.supervisor.state is not State.HOLD:
            self.holds.interrupt(now_ns, self.holds.waits_for)
            return
        if self.scans.failed:
            self.scans.restart()
        if waiting := self._watch.waiting_for():
            self.holds.interrupt(now_ns, ", ".join(waiting))
        self._watch.restore_guardian(now_ns)
        if self._rearm_signalled:
            self._rearm_signalled = False
            self.holds.ask()
        if self.holds.may_end(now_ns):
            self._resume()
        elif self.holds.is_too_long(now_ns):
            self.incidents.give_hold_up()

    def _resume(self) -> None:
        self.scheduler.ignore_next("arming after a hold")
        try:
            self.supervisor.resume()
        except HalError as error:
            self.incidents.report_error(finding_of_output(error), self._devices.amplifier.name, error)
        else:
            self.incidents.end_hold()

    def _ramp_without_scans(self) -> None:
        """Finish the ramp on the host clock (the loop, or what drove it, may be gone) and let the outputs settle."""
        pause_ns, interrupts = self._period_ns, None
        while self.supervisor.state is State.SAFE_RAMP:
            due_ns = self._clock.now_ns() + pause_ns
            self._step_ramp()
            if self.supervisor.is_retrying:
                interrupts = self._interrupts if interrupts is None else interrupts
                pause_ns = min(2 * pause_ns, LONGEST_PAUSE_NS) if self.supervisor.ramp_failure else self._period_ns
                self._is_told_to_give_up = self._interrupts > interrupts
            self._clock.sleep_until_ns(due_ns)
        self._clock.sleep_until_ns(self._clock.now_ns() + SETTLE_TICKS * self._period_ns)

    def _tell_end(self) -> None:
        """Report the safe state to the bench page before the run's outcome is there."""
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
                # the link may be what failed: the first error is the one to report
                self.incidents.error = self.error or (None if self.supervisor.safe_reached else error)

    # -- tasks --------------------------------------------------------------------------------------------

    def _sense(self, info: TickInfo) -> None:
        frame, block, ticks = self._frame, self.scans.block, self._ticks
        assert ticks is not None
        self.incidents.tick = info.k
        frame[TIME] = (info.due_ns - self._started_ns) * 1e-9
        if block.n == 0:  # nothing to compute with: the filters coast when the next scan is there
            frame[STATUS] = FrameStatus.STALE
            return
        row = info.k - ticks.k0
        frame[TICK] = info.k
        frame[STATUS] = FrameStatus.GAP if block.lost and row == 0 else 0
        scan = self.scans.rows[row]
        frame[COUNTS : COUNTS + len(scan)] = scan
        impossible = self._check.scan(scan, info.k)
        if impossible and (impossible := self._redundancy.impossible(self._check.channel, impossible)):
            self.incidents.doubt(Finding.INPUT_IMPOSSIBLE, what=impossible)
        if self._field is not None:
            self._field.fill(frame)

    def _estimate(self, info: TickInfo) -> None:
        """Run the whole step in one compiled call. Of scans that came late, only the newest leads to a command."""
        assert self._ticks is not None
        if int(self._frame[STATUS]) & FrameStatus.STALE:
            return
        if self.supervisor.is_holding:
            self.stages.hold(self._devices.amplifier.told_V)
        elif self.supervisor.may_move and info.k == self._ticks.k0 + self._ticks.n - 1:
            if self.manual.active:
                self.stages.follow(self.manual.step(self._clock.now_ns()))
            else:
                self.stages.command()
        self.stages.step()
        self._judge_step()

    def _judge_step(self, disagreement: str | None = None) -> None:
        """Report what the step's frame reveals. ``disagreement``: what the check of pairs has said already."""
        bits = int(self._frame[STATUS])
        # check before the command goes out: a sensor that contradicts its twin must not move anything
        if self._redundancy.there:
            if unclear := self._redundancy.agree(self._frame):
                self.incidents.doubt(Finding.AXES_CONTRADICT, what=unclear)
        elif not bits & (FrameStatus.INVALID | FrameStatus.STALE) and (
            apart := self._check.pairs(self._frame) if disagreement is None else disagreement
        ):
            self.incidents.doubt(Finding.PAIRS_DISAGREE, what=apart)
        status = bits & (FrameStatus.JERK | FrameStatus.DRIFT)
        if status != self._warned:
            self._warn(status & ~self._warned)
            self._warned = status

    def _warn(self, rising: int) -> None:
        """Count and record the warnings whose bits in the frame's status have just risen."""
        for bit, what in ((FrameStatus.JERK, "jerk"), (FrameStatus.DRIFT, "drift")):
            if rising & bit:
                self.supervisor.warn(what)
                self.incidents.note({"event": what})

    def _actuate(self, info: TickInfo) -> None:
        if self.supervisor.may_move:
            amplifier = self._devices.amplifier
            sent = amplifier.commands_sent
            try:
                clipped = amplifier.write(self.stages.command_V)
            except HalError as error:
                self.incidents.report_error(finding_of_output(error), amplifier.name, error)
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
        else:
            self._step_ramp()

    def _step_ramp(self) -> None:
        was_holding = self.supervisor.is_holding
        if self.supervisor.step(may_retry=self._may_retry()) and self.safe_reached_ns is None:
            self.safe_reached_ns = self._clock.now_ns()
        trip = self.supervisor.trip_cause
        if self.supervisor.state is State.HOLD and self.supervisor.holds[-1].neutral_ns is None:
            self.supervisor.holds[-1].neutral_ns = self._clock.now_ns()
        if was_holding and trip is not None:
            self.incidents.note({"event": "safe state", "reason": trip.reason})

    def _may_retry(self) -> bool:
        """Return True while a failing ramp is retried: for ``neutral_retry_s``, unless the operator interrupts it."""
        trip = self.supervisor.trip_cause
        since_ns = 0 if trip is None else self._clock.now_ns() - trip.t_ns
        return not self._is_told_to_give_up and since_ns < self._config.safety.neutral_retry_s * 1e9

    def _publish(self, info: TickInfo) -> None:
        """Publish and record the frame. A tick without a scan writes no row, so that a replay sees what the filters
        saw."""
        if int(self._frame[STATUS]) & FrameStatus.STALE:
            return
        if self._live is not None:
            self._live.publish(self._frame)
        if self._recorder is not None:
            self._recorder.push(self._frame)

    def _supervise(self, info: TickInfo) -> None:
        """Obey the page's orders, then check, at 100 Hz, what may end the run and no other task sees."""
        if self._orders is not None:
            self._orders.obey_all()
        self._watch.supervise(info)

    def _send_telemetry(self, info: TickInfo) -> None:
        telemetry = self._devices.telemetry
        assert telemetry is not None
        frame, state = self._frame, int(self.supervisor.state)
        telemetry.heartbeat.state = state
        scheduler = self.scheduler
        try:
            telemetry.send_tremor(self.shown.amplitude_um(), float(frame[TREMOR_FREQUENCY]))
            telemetry.send_state(
                state, int(frame[STATUS]), self.counts.lost, scheduler.skipped_ticks, scheduler.worst_tick_ns * 1e-3
            )
        except HalError as error:
            self.incidents.report_error(finding_of_button(error), telemetry.name, error)

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
