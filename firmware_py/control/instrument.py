"""The first instrument: a tick turns a scan into a command.

A tick is due when its scan was taken (device clock). A tick runs sense, estimate and actuate first, then
everything that can wait (``tasks``). Nothing here knows whether the bench is real.
"""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Sequence
from contextlib import AbstractContextManager
from typing import Any

import numpy as np

from firmware_py.control.config import FirmwareConfig
from firmware_py.control.field_input import FieldInput
from firmware_py.control.manual import ManualDrive
from firmware_py.control.orders import HandOrders
from firmware_py.control.plausibility import ScanCheck, turns_of_pairs
from firmware_py.control.program import Program, ProgramDrive
from firmware_py.control.redundancy import Redundancy
from firmware_py.control.scan_input import ScanInput
from firmware_py.control.stages import Stages
from firmware_py.control.tasks import task_rows
from firmware_py.control.watch import Watch
from firmware_py.control.wiring import Devices
from firmware_py.frame import (
    CLIP,
    CLIP_YIELD,
    COMMAND,
    COUNTS,
    STATUS,
    TICK,
    TIME,
    TREMOR_AMPLITUDE,
    TREMOR_FREQUENCY,
    FrameStatus,
)
from firmware_py.run.context import Run
from firmware_py.run.findings import Finding, classify_button_error, classify_output_error
from firmware_py.run.orders import PageOrders
from firmware_py.run.safety import SelfTestLimits
from firmware_py.run.tasks import TaskRow
from firmware_py.scheduler.histogram import DurationHistogram
from firmware_py.scheduler.task import TickInfo
from firmware_py.scheduler.ticker import ScanTicker, Ticks
from hal.contracts import AnalogOutput
from hal.errors import HalError

LATE_PART = 0.9  # latency of a late command, in periods; the prediction bridges a known delay, which this exceeds


class Micron:
    """Runs the opened devices in ``run``: senses, estimates the tremor, and moves the tip against it.

    ``program``: voltages that the outputs play in place of the compensation."""

    def __init__(
        self, devices: Devices, stages: Stages, config: FirmwareConfig, run: Run, program: Program | None = None
    ) -> None:
        assert run.output is not None  # a bench without a piezo output is refused
        self.run = run
        self.stages = stages
        self.devices = devices
        self.frame = stages.frame
        self.budget_us: dict[str, float] = config.budget_us
        self.self_test: SelfTestLimits | None = config.self_test
        self.output: AnalogOutput = run.output
        self.scans = ScanInput(devices.daq, len(devices.scan.channels), run)
        self.closers: Sequence[Callable[[], object]] = (devices.daq.stop, run.output.close, self.scans.count_unread)
        self._warned = 0
        actuation = stages.configs.actuation
        limits_V = (actuation.low_V, actuation.high_V, actuation.neutral_V)
        self.manual = ManualDrive(*limits_V) if program is None else ProgramDrive(*limits_V, program)
        self._orders = PageOrders(run, HandOrders(self.manual, stages, run).obey)
        self._field = None
        if devices.magnetometer is not None:
            self._field = FieldInput(devices.magnetometer, run, config.plausibility.magnetometer_outlier_V)
        self._check = scan_check(devices, stages, config)
        self._redundancy = Redundancy(stages, self._check, run, devices.scan_labels)
        self._watch = Watch(devices, self.frame, self._check, run)
        self._ticker = ScanTicker(
            self.scans.read, run.clock, run.period_ns, silent_after_ns=round(run.limits.stale_ms * 1e6)
        )
        self.tasks: Sequence[TaskRow] = task_rows(self, devices.polling, devices.bus_us)

    # -- what the loop asks -------------------------------------------------------------------------------

    def prepare(self) -> None:
        pass

    def running(self) -> AbstractContextManager[object]:
        return contextlib.nullcontext()

    def start(self) -> None:
        self.scans.start()

    def wait(self) -> Ticks | None:
        """Return the next ticks. A failed scan is reported, and the host clock drives the loop until it runs again."""
        try:
            return self._ticker.wait()
        except HalError:
            if self.run.supervisor.trip_cause is not None:
                raise
        self.scans.take_none(self.run.clock.now_ns())
        return self._ticker.tick_without_scan()

    def poll(self) -> Ticks | None:
        try:
            return self._ticker.poll()
        except HalError:  # it has been reported
            return None

    def inspect_ticks(self, ticks: Ticks) -> None:
        self.scans.inspect_ticks(ticks)

    def rest(self) -> None:
        self.manual.stop()

    def repair(self) -> None:
        if self.scans.failed:
            self.scans.restart()

    def waiting_for(self) -> list[str]:
        return self._watch.waiting_for()

    # -- tasks --------------------------------------------------------------------------------------------

    def sense(self, info: TickInfo) -> None:
        """Put the counts of a scan into the frame. An impossible reading ends the run."""
        frame, block, ticks = self.frame, self.scans.block, self.run.ticks
        assert ticks is not None
        self.run.incidents.tick = info.k
        frame[TIME] = (info.due_ns - self.run.started_ns) * 1e-9
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
            self.run.incidents.report_reading(Finding.INPUT_IMPOSSIBLE, what=impossible)
        if self._field is not None:
            self._field.fill(frame)

    def estimate(self, info: TickInfo) -> None:
        """Run the whole step in one compiled call. Of scans that came late, only the newest leads to a command."""
        ticks, supervisor = self.run.ticks, self.run.supervisor
        assert ticks is not None
        if int(self.frame[STATUS]) & FrameStatus.STALE:
            return
        if supervisor.is_holding:
            self.stages.hold(self.output.commanded_V)
        elif supervisor.may_move and info.k == ticks.k0 + ticks.n - 1:
            if self.manual.active:
                self.stages.follow(self.manual.step(self.run.clock.now_ns()))
            else:
                self.stages.command()
        self.stages.step()
        self._judge_step()

    def _judge_step(self, disagreement: str | None = None) -> None:
        """Report what the step's frame reveals. ``disagreement``: what the check of pairs has said already."""
        bits = int(self.frame[STATUS])
        incidents = self.run.incidents
        # check before the command goes out: a sensor that contradicts its twin must not move anything
        if self._redundancy.has_spare_axes:
            if unclear := self._redundancy.agree(self.frame):
                incidents.report_reading(Finding.AXES_CONTRADICT, what=unclear)
        elif not bits & (FrameStatus.INVALID | FrameStatus.STALE) and (
            apart := self._check.pairs(self.frame) if disagreement is None else disagreement
        ):
            incidents.report_reading(Finding.PAIRS_DISAGREE, what=apart)
        status = bits & (FrameStatus.JERK | FrameStatus.DRIFT)
        if status != self._warned:
            self._warn(status & ~self._warned)
            self._warned = status

    def _warn(self, rising: int) -> None:
        """Count and record the warnings whose bits in the frame's status have just risen."""
        for bit, what in ((FrameStatus.JERK, "jerk"), (FrameStatus.DRIFT, "drift")):
            if rising & bit:
                self.run.supervisor.warn(what)
                self.run.incidents.note({"event": what})

    def actuate(self, info: TickInfo) -> None:
        """Hand the volts on if the supervisor lets them, else run one step of the ramp to neutral."""
        run = self.run
        if not run.supervisor.may_move:
            run.step_ramp()
            return
        output = self.output
        sent = output.commands_sent
        try:
            clipped = output.write(self.stages.command_V)
        except HalError as error:
            run.incidents.report_error(classify_output_error(error), output.name, error)
            return
        run.counts.clipped += bool(clipped != 0 or int(self.frame[CLIP]) & ~CLIP_YIELD)
        if output.commands_sent == sent:
            run.counts.superseded += 1
            return
        latency_ns = run.clock.now_ns() - info.due_ns
        if latency_ns > LATE_PART * run.period_ns:
            run.incidents.notice("commands were late")
        run.counts.latency.add(latency_ns, info.k)
        run.counts.commands += 1

    def publish(self, info: TickInfo) -> None:
        """Publish and record the frame. A tick without a scan writes no row, so that a replay sees what the filters
        saw."""
        if not int(self.frame[STATUS]) & FrameStatus.STALE:
            self.run.publish(self.frame)

    def supervise(self, info: TickInfo) -> None:
        """Obey the page's orders, then check, at 100 Hz, what may end the run and no other task sees."""
        self._orders.handle_orders()
        self._watch.supervise(info)

    def verify(self, info: TickInfo) -> None:
        """Read the outputs back."""
        self._watch.verify_output(info)

    def monitor(self, info: TickInfo) -> None:
        """Measure what arrives at the stacks."""
        self._watch.monitor_output(info)

    def magnetometer(self, info: TickInfo) -> None:
        """Read one axis of the magnetic field."""
        if self._field is not None:
            self._field.poll(info)

    def telemetry(self, info: TickInfo) -> None:
        """Tell other nodes of the CAN bus what the instrument does."""
        telemetry = self.devices.telemetry
        assert telemetry is not None
        run, frame, state = self.run, self.frame, int(self.run.supervisor.state)
        telemetry.heartbeat.state = state
        skipped, worst_us = run.scheduler.skipped_ticks, run.scheduler.worst_tick_ns * 1e-3
        try:
            telemetry.send_tremor(self._amplitude_um(), float(frame[TREMOR_FREQUENCY]))
            telemetry.send_state(state, int(frame[STATUS]), run.counts.lost, skipped, worst_us)
        except HalError as error:
            run.incidents.report_error(classify_button_error(error), telemetry.name, error)

    # -- what people see ----------------------------------------------------------------------------------

    def _amplitude_um(self) -> list[float]:
        """Return the tremor's amplitude along x, y, z."""
        return [1e6 * float(v) for v in self.frame[TREMOR_AMPLITUDE : TREMOR_AMPLITUDE + 3]]

    def histograms(self) -> dict[str, DurationHistogram]:
        return {"sample to command": self.run.counts.latency}

    def numbers(self) -> dict[str, object]:
        frame = self.frame
        return {
            **(self._page_numbers() if self.run.live is not None else {}),
            "t_s": float(frame[TIME]),
            "amplitude_um": self._amplitude_um(),
            "frequency_hz": [float(v) for v in frame[TREMOR_FREQUENCY : TREMOR_FREQUENCY + 3]],
            "command_V": [float(v) for v in frame[COMMAND : COMMAND + 3]],
            "fallbacks": self.stages.sensing.fallbacks,
        }

    def _page_numbers(self) -> dict[str, object]:
        manual = self.manual
        armed = manual.armed(self.run.clock.now_ns())
        return {
            "manual": "armed" if armed else "returning" if manual.active else "off",
            "gain": float(self.stages.actuation.params["gain"][0]),
            "magnetometer_errors": self.run.counts.magnetometer_errors,
        }

    def report(self) -> dict[str, Any]:
        counts, stages = self.run.counts, self.stages
        return {
            "latency": {"sample_to_command_us": counts.latency.distribution().as_dict()},
            "commands": {
                "sent": counts.commands,
                "superseded": counts.superseded,
                "clipped": counts.clipped,
                # ticks by limit, as the actuation stage sees them
                "limited": stages.actuation.limited,
            },
            "magnetometer_errors": counts.magnetometer_errors,
            "estimator": stages.configs.tremor.method,
            "kinematics": {
                "method": stages.configs.sensing.kinematics_method,
                "fallbacks": stages.sensing.fallbacks,
            },
        }


def scan_check(devices: Devices, stages: Stages, config: FirmwareConfig) -> ScanCheck:
    """Return the plausibility check of the scans of ``devices``."""
    wired, sensing = devices.sensing_table, stages.configs.sensing
    watched = [*wired["channels"], wired["supply_channel"], wired["temperature_channel"]]
    columns = [column for column in watched if column is not None]
    return ScanCheck(
        config.plausibility, wired["lsb_V"], columns, devices.scan_labels, sensors=len(wired["channels"]),
        mix=turns_of_pairs(sensing.axis_positions(), np.array(sensing.axes)),
    )  # fmt: skip
