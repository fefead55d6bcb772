"""The scans of the DAQ as the loop reads them: failures are reported, starts repeated, every scan counted.

A scan that the device took is received, lost or, at the end, unread. Silence is the device's only while this host was
awake (``Run.host_stalled_ms``).
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from firmware_py.control.wiring import Daq
from firmware_py.run.context import Run
from firmware_py.run.findings import Finding, classify_scan_error
from firmware_py.scheduler.ticker import Ticks
from hal.errors import HalError
from hal.types import ScanBlock, Status, TimeSource

MAX_BLOCK = 1024  # the deepest FIFO of a DAQ: one read empties it


class ScanInput:
    """Reads the scans of ``daq`` into ``rows`` (of ``columns`` readings each) and ``block``."""

    def __init__(self, daq: Daq, columns: int, run: Run) -> None:
        self.rows = np.zeros((MAX_BLOCK, columns), dtype=np.int16)
        self.block = ScanBlock(0, 0, run.period_ns, 0, TimeSource.HOST)
        self.failed = False
        """The scan must be started anew."""
        self._daq = daq
        self._run = run
        self._limits = run.limits
        self._clock = run.clock
        self._period_ns = run.period_ns
        self._counts = run.counts
        self._incidents = run.incidents
        self._handed_over: Callable[[], ScanBlock] | None = None
        self._was_silent = False
        self._newest_ns = 0  # of the scans that are counted; the start of the scan before the first

    def start(self) -> None:
        """Start the scan; what the device takes from here on is read, lost or unread."""
        self._daq.start()
        self._newest_ns = self._clock.now_ns()

    def read(self, timeout_s: float) -> ScanBlock:
        """Return the next scans, none when the time is up. While the scan has ``failed``, only time passes.

        Reports an error of the DAQ, then raises it as ``HalError``."""
        due_ns = self._clock.now_ns() + round(timeout_s * 1e9)
        if self.failed:
            self._clock.sleep_until_ns(due_ns)
            return self.take_none(due_ns)
        try:
            if self._handed_over is not None:
                take, self._handed_over = self._handed_over, None
                block = take()
            else:
                block = self._daq.read_scans(self.rows, timeout_s)
        except HalError as error:
            self._run.host_gaps.record(due_ns, self._clock.now_ns())
            stall_ms = self._run.host_stalled_ms()
            finding = classify_scan_error(error, stall_ms)
            self._incidents.report_error(finding, self._daq.name, error, stall_ms=stall_ms)
            self.failed = True
            raise
        self._run.host_gaps.record(due_ns, self._clock.now_ns())
        self.block = block
        if block.n:
            self._newest_ns = block.t0_ns + (block.n - 1) * block.dt_ns
            if block.status & Status.SHIFTED:
                self._incidents.notice(f"scans of {self._daq.name} come at another time than their clock says")
        self._counts.received += block.n
        if block.lost:
            self._incidents.notice("scans were lost")
            self._counts.lost += block.lost
        self._counts.expected += block.n + block.lost
        return block

    def hand_over(self, take: Callable[[], ScanBlock]) -> None:
        """Let the next ``read`` return ``take()``, a block that a compiled loop has put into ``rows``, or fail with
        it."""
        self._handed_over = take

    def note_run(self, n: int, newest_ns: int) -> None:
        """Count ``n`` scans that a compiled loop has read and run, the newest taken at ``newest_ns``."""
        self._newest_ns = newest_ns
        self._counts.received += n
        self._counts.expected += n

    @property
    def are_well(self) -> bool:
        """True while scans come and none has failed."""
        return not (self.failed or self._was_silent or self._handed_over is not None)

    def take_none(self, t_ns: int) -> ScanBlock:
        """Replace ``block`` by an empty one of the host's time ``t_ns``."""
        self.block = ScanBlock(0, t_ns, self._period_ns, 0, TimeSource.HOST)
        return self.block

    def inspect_ticks(self, ticks: Ticks) -> None:
        """Report what the arrival of ``ticks`` reveals about the link and this host."""
        limits, name, holds = self._limits, self._daq.name, self._incidents.holds
        if ticks.n > 1:
            if not self._run.scheduler.is_announced:  # an arming that ramps takes its time
                self._incidents.notice("scans came late")
            if ticks.n * ticks.dt_ns > limits.stalled_ms * 1e6:
                self._incidents.report(Finding.HOST_LATE, scans=ticks.n, device=name)
            elif self._run.supervisor.is_holding and ticks.n * ticks.dt_ns > limits.stale_ms * 1e6:
                holds.interrupt(self._clock.now_ns(), "scans that come in time")
        if ticks.source is not TimeSource.HOST:
            # bytes may have been lost: only a scan that is started anew is known to be whole, and when it was taken
            self.failed = self._was_silent
            self._was_silent = False
        elif not self.failed:
            self._was_silent = True
            if stall_ms := self._run.host_stalled_ms():
                self._incidents.report(Finding.HOST_OVERSLEPT, stall_ms=stall_ms, device=name)
            else:
                self._incidents.report(Finding.SCANS_MISSING, device=name, limit_ms=limits.stale_ms)

    def restart(self) -> None:
        """Begin a new scan after one that failed, with outputs at neutral, because the driver may take a while for it.
        Scans that the device has taken meanwhile are lost."""
        daq, newest_ns = self._daq, self._newest_ns
        try:
            daq.stop()
            self.start()
        except HalError as error:
            self._incidents.report_error(classify_scan_error(error, 0.0), daq.name, error, stall_ms=0.0)
            return
        self.failed = False
        self._incidents.holds.interrupt(self._newest_ns, f"scans of {daq.name}")
        lost = max(0, (self._newest_ns - newest_ns) // self._period_ns)
        self._counts.lost += lost
        self._counts.expected += lost

    def count_unread(self) -> None:
        """Count the scans that the device has had time for since the last one that was read."""
        if self._newest_ns:  # the scan was started
            self._counts.unread = max(0, (self._clock.now_ns() - self._newest_ns) // self._period_ns)
