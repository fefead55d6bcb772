"""The watch over a run: the self-test before arming, and at 100 Hz everything that no task sees by itself."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from firmware_py.control.config import FirmwareConfig
from firmware_py.control.incidents import Incidents
from firmware_py.control.plausibility import ScanCheck
from firmware_py.control.safety import Supervisor
from firmware_py.control.wiring import Devices
from firmware_py.frame import STATUS, SUPPLY, TEMPERATURE, FrameStatus
from firmware_py.scheduler.task import TickInfo
from hal.errors import HalError

GUARDIAN_SILENT_NS = 100_000_000


class Watch:
    """Reads the frame and the devices; its only consequence is a trip."""

    def __init__(
        self,
        devices: Devices,
        config: FirmwareConfig,
        frame: NDArray[np.float64],
        check: ScanCheck,
        supervisor: Supervisor,
        incidents: Incidents,
    ) -> None:
        self._devices = devices
        self._config = config
        self._frame = frame
        self._check = check
        self._supervisor = supervisor
        self._incidents = incidents

    def supervise(self, info: TickInfo) -> None:
        """Task: readings that are impossible for a while, the room, the stop button."""
        frame, limits, incidents = self._frame, self._config.safety, self._incidents
        status = int(frame[STATUS])
        t_ns = info.due_ns
        if status & FrameStatus.INVALID:
            incidents.doubt("not a number", "a reading or estimate is not a number; see the recording")
        incidents.bad_for(
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
            reason = f"{name} {value:.2f} {unit} is outside {lo:g}..{hi:g} {unit}"
            incidents.bad_for(name, outside, t_ns, 100.0, reason)
        if odd := self._check.odd():
            incidents.notice(odd)
        self._look_after_the_guardian(t_ns)
        telemetry = self._devices.telemetry
        if telemetry is not None:
            if telemetry.poll():
                incidents.trip("stop button pressed")
            elif telemetry.button_silent() and self._supervisor.may_move:
                incidents.trip(
                    f"{telemetry.name}: the stop button is not heard any more; check the CAN bus and the button"
                )

    def _look_after_the_guardian(self, t_ns: int) -> None:
        """Heartbeats go both ways: without a guardian the run goes on, but somebody should know."""
        heart = self._devices.guardian
        if heart is not None and t_ns - heart.watched_ns > GUARDIAN_SILENT_NS and self._supervisor.may_move:
            self._incidents.notice("the guardian of the outputs is not heard any more")

    def verify_output(self, info: TickInfo) -> None:
        """Task, 100 Hz, or 300 without a monitor: the amplifier must hold what it was told. A DAC that restarted or
        misheard does not."""
        assert self._devices.verify_output is not None
        if not self._supervisor.may_move:
            return
        name = self._devices.amplifier.name
        try:
            if wrong := self._devices.verify_output():
                self._incidents.trip(f"{name}: {self._taken() or f'{wrong}; check its supply and the bus'}")
        except HalError as error:
            self._incidents.error = error
            self._incidents.trip_for(name, error)

    def _taken(self) -> str:
        """What a stall of this process looks like from an output that the guardian has moved meanwhile."""
        heart = self._devices.guardian
        if heart is None or not heart.taken_ns:
            return ""
        return "the host stood still: the guardian has the outputs and takes them to neutral"

    def monitor_output(self, info: TickInfo) -> None:
        """Task, 400 Hz: what arrives at the stacks must be what was told."""
        monitor = self._devices.monitor
        assert monitor is not None
        if not self._supervisor.may_move:
            monitor.forget()
            return
        name, limit_ms = self._devices.amplifier.name, self._config.safety.monitor_ms
        deaf, reason = False, ""
        try:
            if wrong := monitor.poll():
                self._incidents.trip(f"{name}: {self._taken() or wrong}")
        except HalError as error:
            deaf, reason = True, f"{monitor.name}: {error}"
            monitor.forget()
            self._incidents.notice("amplifier monitor does not answer")
        self._incidents.bad_for("monitor", deaf, info.due_ns, limit_ms, reason)

    def self_test_passed(self, watched_ms: float) -> bool:
        """Sensors have been watched long enough and are sane; trips when that takes too long."""
        limits = self._config.self_test
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
            self._incidents.trip(f"self-test: {', '.join(waiting)} after {limits.limit_ms:g} ms")
        return False
