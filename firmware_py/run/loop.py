"""Runs an instrument: one pass per tick runs the tasks that are due; a supervisor may stop it.

The loop knows when to arm, how a hold ends, how the outputs get to neutral and what ends the run. What a tick does is
the instrument's table of tasks. Nothing here knows whether the bench is real.
"""

from __future__ import annotations

from collections.abc import Generator

from firmware_py.run.context import Run
from firmware_py.run.findings import Finding, classify_output_error
from firmware_py.run.instrument import Instrument
from firmware_py.run.safety import State
from firmware_py.run.status import collect_histograms, collect_numbers
from firmware_py.run.tasks import bind_tasks
from firmware_py.scheduler.histogram import DurationHistogram
from firmware_py.scheduler.scheduler import Scheduler
from firmware_py.scheduler.task import BackgroundSpec
from hal.contracts import ARMING_STEP_S
from hal.errors import HalError

SETTLE_TICKS = 5
"""Ticks that the loop waits after the last ramp step, so that the amplifier reaches neutral."""
LONGEST_PAUSE_NS = 10_000_000
"""Longest pause between two attempts at a ramp step over a failing bus. The pauses double up to this value."""
HOST_PATIENCE = 10.0
"""Factor by which the self-test may take longer on a host that stands still again and again."""
STATUS_PERIOD_NS = 200_000_000


class Loop:
    """Runs ``instrument`` in ``run``."""

    def __init__(self, run: Run, instrument: Instrument) -> None:
        self._run = run
        self._instrument = instrument
        self._disturbed_ns = 0
        tick_hz = round(1e9 / run.period_ns)
        run.scheduler = Scheduler(
            bind_tasks(instrument.tasks, tick_hz, instrument.budget_us),
            run.clock,
            period_ns=run.period_ns,
            background=self._background(),
        )
        instrument.prepare()

    def _background(self) -> list[BackgroundSpec]:
        live = self._run.live
        background = [BackgroundSpec("status", self._report_status, worst_step_us=150.0)] if self._run.on_status else []
        if live is not None:
            background.append(BackgroundSpec("histograms", lambda: live.show(self.histograms), worst_step_us=30.0))
        return background

    def histograms(self) -> dict[str, DurationHistogram]:
        """Return every live histogram by its name on the page."""
        return collect_histograms(self._run, self._instrument.histograms())

    def run(self, seconds: float) -> None:
        """Run the self-test, arm, run for ``seconds`` after arming, ramp to neutral. Always ends in the safe state.

        A hardware error becomes the reason of the trip and is kept in ``Incidents.error``; anything else is raised
        again after the ramp.
        """
        incidents = self._run.incidents
        with self._instrument.running(), self._run.signals.caught():
            try:
                self._start(seconds)
                self._run_ticks(seconds)
            except HalError as error:
                incidents.error = error
                incidents.report(Finding.DEVICE_FAILED, error=error)
            except BaseException as error:
                incidents.report(Finding.FIRMWARE_FAILED, error=f"{type(error).__name__}: {error}")
                raise
            finally:
                finish_ramp(self._run)
                self._report_end()
                self._close()

    def _start(self, seconds: float) -> None:
        run = self._run
        if run.sense_only:
            run.supervisor.begin_sensing()
        else:
            run.supervisor.begin_self_test()
        run.started_ns = run.clock.now_ns()
        self._instrument.start()
        if self._instrument.self_test is None and not run.sense_only:
            self._arm(seconds)

    def _run_ticks(self, seconds: float) -> None:
        run, instrument, supervisor = self._run, self._instrument, self._run.supervisor
        while not supervisor.is_safe and not supervisor.must_not_wait:
            if (ticks := instrument.wait()) is None:
                continue
            awake_ns = run.clock.now_ns()
            run.ticks = ticks
            run.incidents.tick = ticks.k0
            newest_ns = ticks.due_ns + (ticks.n - 1) * ticks.dt_ns
            instrument.inspect_ticks(ticks)
            if run.signals.interrupted:
                run.incidents.report(Finding.STOPPED, signal=run.signals.interrupted)
            elif run.end_ns is not None and newest_ns >= run.end_ns and self._may_finish():
                run.incidents.report(Finding.FINISHED)
            elif run.end_ns is None and run.sense_only:
                run.end_ns = newest_ns + round(seconds * 1e9)
            if supervisor.is_safe:  # there are no outputs whose ramp the tasks would run
                break
            run.scheduler.run(ticks)
            run.host_gaps.record(awake_ns + run.period_ns, run.clock.now_ns())
            if supervisor.state is State.SELF_TEST and self._self_test_passed():
                self._arm(seconds)
            elif supervisor.is_holding:
                self._update_hold()
            run.scheduler.run_slack(newest_ns + ticks.dt_ns + run.period_ns)

    # -- arming and holds ---------------------------------------------------------------------------------

    def _self_test_passed(self) -> bool:
        """Return True once the sensors were good for ``watch_ms`` without interruption.

        Trips when that takes longer than ``limit_ms`` since the start, or since the host last stood still, up to
        ``HOST_PATIENCE`` times as long. Both limits are ``[firmware.self_test]`` of the bench file.
        ``Holds.waits_for`` names an interruption."""
        run, limits = self._run, self._instrument.self_test
        assert limits is not None
        self._instrument.repair()
        now_ns, holds = run.clock.now_ns(), run.incidents.holds
        run.restore_guardian()
        if run.host_stalled_ms():
            self._disturbed_ns = now_ns
        since_start_ms = (now_ns - run.started_ns) * 1e-6
        undisturbed_ms = (now_ns - self._disturbed_ns) * 1e-6
        waiting = self._instrument.waiting_for()
        if not waiting and min(since_start_ms, holds.good_ms(now_ns)) >= limits.watch_ms:
            return True
        if what := ", ".join(waiting) or holds.waits_for:
            longest_ms = HOST_PATIENCE * limits.limit_ms
            if min(since_start_ms, undisturbed_ms) > limits.limit_ms:
                run.incidents.report(Finding.SELF_TEST_FAILED, what=what, limit_ms=limits.limit_ms)
            elif since_start_ms > longest_ms:
                run.incidents.report(Finding.SELF_TEST_DISTURBED, what=what, limit_ms=longest_ms)
        return False

    def _arm(self, seconds: float) -> None:
        run = self._run
        run.scheduler.ignore_next("arming")
        try:
            run.supervisor.arm(self._pass_arming_step)
        except HalError as error:
            run.incidents.report_error(Finding.OUTPUT_FAILED, self._output_name, error)
            return
        if run.supervisor.may_move:
            run.armed_ns = run.clock.now_ns()
            run.end_ns = run.armed_ns + round(seconds * 1e9)

    def _pass_arming_step(self) -> None:
        """Wait for ``ARMING_STEP_S`` after a step of arming, and run the ``catch_up`` tasks for scans that have come.
        They cannot be left for later: the DAQ buffers few scans, and an armed node must get its next command in time.
        """
        run = self._run
        until_ns = run.clock.now_ns() + round(ARMING_STEP_S * 1e9)
        if (ticks := self._instrument.poll()) is not None:
            run.ticks = ticks
            for i in range(ticks.n):
                run.scheduler.catch_up(ticks.due_ns + i * ticks.dt_ns, ticks.k0 + i)
        run.clock.sleep_until_ns(until_ns)

    @property
    def _output_name(self) -> str:
        """Return the output's name in the bench file for an error, because a port knows only its path."""
        return self._run.output.name if self._run.output is not None else ""

    def _may_finish(self) -> bool:
        """Return False in a hold whose cause has not passed, because "run finished" would hide the cause."""
        return not self._run.supervisor.is_holding or self._run.incidents.holds.is_ready

    def _update_hold(self) -> None:
        """End the hold, wait, or abandon it; called once per pass while the outputs ramp to neutral or rest there."""
        run, holds = self._run, self._run.incidents.holds
        now_ns = run.clock.now_ns()
        self._instrument.rest()
        if run.supervisor.state is not State.HOLD:
            holds.interrupt(now_ns, holds.waits_for)
            return
        self._instrument.repair()
        if waiting := self._instrument.waiting_for():
            holds.interrupt(now_ns, ", ".join(waiting))
        run.restore_guardian()
        if run.signals.rearm_asked:
            run.signals.rearm_asked = False
            holds.ask()
        if holds.may_end(now_ns):
            self._resume()
        elif holds.has_timed_out(now_ns):
            run.incidents.abandon_hold()

    def _resume(self) -> None:
        run = self._run
        run.scheduler.ignore_next("arming after a hold")
        try:
            run.supervisor.resume(self._pass_arming_step)
        except HalError as error:
            run.incidents.report_error(classify_output_error(error), self._output_name, error)
            run.incidents.holds.note_refusal(run.clock.now_ns())
            return
        if run.supervisor.may_move:
            run.incidents.end_hold()

    # -- the end ------------------------------------------------------------------------------------------

    def _report_end(self) -> None:
        """Report the safe state to the bench page before the run's outcome is there."""
        run, trip = self._run, self._run.supervisor.trip_cause
        if run.live is not None and run.on_status is not None and trip is not None:
            run.on_status(
                {
                    "event": "safe state",
                    "reason": trip.reason,
                    "normal": trip.normal,
                    "reached": run.supervisor.safe_reached,
                    "asked_ns": run.asked_safe_ns,
                    "tripped_ns": trip.t_ns,
                    "reached_ns": run.safe_reached_ns,
                }
            )

    def _close(self) -> None:
        incidents = self._run.incidents
        for close in self._instrument.closers:
            try:
                close()
            except HalError as error:
                # the link may be what failed: the first error is the one to report
                incidents.error = incidents.error or (None if self._run.supervisor.safe_reached else error)

    def _report_status(self) -> Generator[bool, None, None]:
        run = self._run
        assert run.on_status is not None
        every = STATUS_PERIOD_NS // run.period_ns
        next_k = 0
        while True:
            k = run.ticks.k0 if run.ticks is not None else 0
            if k >= next_k:
                next_k = k + every
                run.on_status({**collect_numbers(run), **self._instrument.numbers()})
            yield False


def finish_ramp(run: Run) -> None:
    """Finish the ramp on the host clock, because the scans may have stopped, and let the outputs settle.

    A ramp step that fails is tried again for ``[firmware.safety] neutral_retry_s``, with pauses that double up to
    ``LONGEST_PAUSE_NS``. Another SIGINT or SIGTERM during the retries gives the ramp up; neutral is then not confirmed.
    """
    supervisor, signals = run.supervisor, run.signals
    if run.output is None:
        run.safe_reached_ns = supervisor.trip_cause.t_ns if supervisor.trip_cause is not None else None
        return
    pause_ns, interrupts = run.period_ns, None
    while supervisor.state is State.SAFE_RAMP:
        due_ns = run.clock.now_ns() + pause_ns
        run.step_ramp()
        if supervisor.is_retrying:
            interrupts = signals.interrupts if interrupts is None else interrupts
            pause_ns = min(2 * pause_ns, LONGEST_PAUSE_NS) if supervisor.ramp_failure else run.period_ns
            run.ramp_given_up = signals.interrupts > interrupts
        run.clock.sleep_until_ns(due_ns)
    run.clock.sleep_until_ns(run.clock.now_ns() + SETTLE_TICKS * run.period_ns)
