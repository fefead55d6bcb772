"""Watches over a run: checks at 100 Hz everything that no task sees, and says what prevents arming."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from firmware_py.control.plausibility import ScanCheck
from firmware_py.control.wiring import Devices
from firmware_py.frame import STATUS, SUPPLY, TEMPERATURE, FrameStatus
from firmware_py.run.context import Run
from firmware_py.run.findings import Finding, classify_button_error, classify_output_error
from firmware_py.run.safety import State
from firmware_py.scheduler.task import TickInfo
from hal.errors import HalError

ROOM_MS = 100.0
"""Time for which temperature or supply may be outside their limits. Both are smoothed, and change slowly."""


class Watch:
    """Reads the frame and the devices; its only consequence is a finding."""

    def __init__(self, devices: Devices, frame: NDArray[np.float64], check: ScanCheck, run: Run) -> None:
        self._devices = devices
        self.frame = frame
        self._check = check
        self._run = run
        self._limits = run.limits
        self._supervisor = run.supervisor
        self._incidents = run.incidents

    def supervise(self, info: TickInfo) -> None:
        """Run the supervising task: check for invalid or saturated readings, temperature, supply, guardian and stop
        button."""
        frame, limits, incidents = self.frame, self._limits, self._incidents
        status = int(frame[STATUS])
        t_ns = info.due_ns
        if status & FrameStatus.INVALID:
            incidents.report_reading(Finding.NOT_A_NUMBER)
        beyond, limit_ms = bool(status & FrameStatus.SATURATED), limits.saturated_ms
        incidents.report_after(Finding.SATURATED, beyond, t_ns, limit_ms, limit_ms=limit_ms)
        known = not status & FrameStatus.ALIGNING
        low, high = limits.temperature_C
        value = float(frame[TEMPERATURE])
        outside = known and not low <= value <= high
        incidents.report_after(Finding.TEMPERATURE_OUTSIDE, outside, t_ns, ROOM_MS, value=value, low=low, high=high)
        low, high = limits.supply_V
        value = float(frame[SUPPLY])
        outside = known and not low <= value <= high
        incidents.report_after(Finding.SUPPLY_OUTSIDE, outside, t_ns, ROOM_MS, value=value, low=low, high=high)
        if odd := self._check.odd():
            incidents.notice(odd)
        self._run.check_guardian()
        self._listen_to_the_button()

    def _listen_to_the_button(self) -> None:
        telemetry, incidents = self._devices.telemetry, self._incidents
        if telemetry is None:
            return
        try:
            if telemetry.poll():
                incidents.report(Finding.BUTTON_PRESSED)
        except HalError as error:
            incidents.report_error(classify_button_error(error), telemetry.name, error)
        if telemetry.button_silent() and (self._supervisor.may_move or self._supervisor.is_holding):
            incidents.report(Finding.BUTTON_SILENT, device=telemetry.name)

    def verify_output(self, info: TickInfo) -> None:
        """Run the read-back task (100 Hz, 300 Hz without a monitor): the amplifier must hold the value it was sent. A
        DAC that restarted or received a wrong value does not, nor one that rests beside neutral in a hold."""
        assert self._devices.verify_output is not None
        lifecycle = self._run.guardian
        rests = self._supervisor.state is State.HOLD and not (lifecycle is not None and lifecycle.heartbeat.taken_ns)
        if not (self._supervisor.may_move or rests):
            return
        name = self._devices.amplifier.name
        try:
            if wrong := self._devices.verify_output():
                self._report_difference(f"{wrong}; check its supply and the bus")
        except HalError as error:
            self._incidents.report_error(classify_output_error(error), name, error)

    def _report_difference(self, what: str) -> None:
        """Report that the outputs differ from the command. After a stall of this process they differ because the
        guardian has moved them; then that is reported instead."""
        lifecycle, name = self._run.guardian, self._devices.amplifier.name
        if lifecycle is not None and lifecycle.heartbeat.taken_ns:
            self._incidents.report(Finding.OUTPUT_TAKEN, device=name)
        else:
            self._incidents.report(Finding.OUTPUT_DIFFERS, device=name, what=what)

    def monitor_output(self, info: TickInfo) -> None:
        """Run the monitor's task (400 Hz): the voltage at the stacks must match the command, also at neutral in a
        hold."""
        monitor = self._devices.monitor
        assert monitor is not None
        if not (self._supervisor.may_move or self._supervisor.state is State.HOLD):
            monitor.forget()
            return
        limit_ms = self._limits.monitor_ms
        deaf, reason = False, ""
        try:
            if wrong := monitor.poll():
                self._report_difference(wrong)
        except HalError as error:
            deaf, reason = True, f"{monitor.name}: {error}"
            monitor.forget()
            self._incidents.notice("amplifier monitor does not answer")
        self._incidents.report_after(Finding.MONITOR_DEAF, deaf, info.due_ns, limit_ms, error=reason)

    def waiting_for(self) -> list[str]:
        """Return the conditions that prevent arming, for the first time or after a hold."""
        status = int(self.frame[STATUS])
        telemetry = self._devices.telemetry
        return [
            name
            for name, wrong in (
                ("attitude is not aligned", status & FrameStatus.ALIGNING),
                ("an accelerometer is out of range", status & FrameStatus.SATURATED),
                ("a reading is not a number", status & FrameStatus.INVALID),
                ("the stop button has not been heard", telemetry is not None and telemetry.button_silent()),
            )
            if wrong
        ]
