"""Reads what the loop shows while it runs: a few numbers for the terminal, the histograms for the page."""

from __future__ import annotations

from firmware_py.control.manual import ManualDrive
from firmware_py.control.stages import Stages
from firmware_py.frame import COMMAND, TIME, TREMOR_AMPLITUDE, TREMOR_FREQUENCY
from firmware_py.run.holds import Holds
from firmware_py.run.incidents import LoopCounts
from firmware_py.run.safety import Supervisor
from firmware_py.scheduler.histogram import DurationHistogram
from firmware_py.scheduler.scheduler import Scheduler
from hal.contracts import Clock


class LoopStatus:
    """Reads the status of a loop's parts and changes nothing. ``for_page`` adds the numbers that only the bench page
    shows."""

    def __init__(
        self,
        stages: Stages,
        counts: LoopCounts,
        supervisor: Supervisor,
        holds: Holds,
        manual: ManualDrive,
        scheduler: Scheduler,
        clock: Clock,
        *,
        for_page: bool,
    ) -> None:
        self._stages = stages
        self.frame = stages.frame
        self._counts = counts
        self._supervisor = supervisor
        self._holds = holds
        self._manual = manual
        self._scheduler = scheduler
        self._clock = clock
        self._for_page = for_page

    def amplitude_um(self) -> list[float]:
        """Return the tremor's amplitude along x, y, z."""
        return [1e6 * float(v) for v in self.frame[TREMOR_AMPLITUDE : TREMOR_AMPLITUDE + 3]]

    def histograms(self) -> dict[str, DurationHistogram]:
        """Return every live histogram, sample to command first."""
        return {"sample to command": self._counts.latency, **self._scheduler.histograms()}

    def numbers(self) -> dict[str, object]:
        """Return the status as JSON values, under the names of the bench page."""
        frame = self.frame
        latency = self._counts.latency.distribution()
        return {
            **(self._page_numbers() if self._for_page else {}),
            "t_s": float(frame[TIME]),
            "state": self._supervisor.state.words,
            "holds": len(self._supervisor.holds),
            "hold": self._holds.as_status(self._clock.now_ns()),
            "amplitude_um": self.amplitude_um(),
            "frequency_hz": [float(v) for v in frame[TREMOR_FREQUENCY : TREMOR_FREQUENCY + 3]],
            "command_V": [float(v) for v in frame[COMMAND : COMMAND + 3]],
            "latency_us": [latency.p50_us, latency.p99_us],
            "lost": self._counts.lost,
            "skipped": self._scheduler.skipped_ticks,
        }

    def _page_numbers(self) -> dict[str, object]:
        now_ns = self._clock.now_ns()
        trip, manual, counts = self._supervisor.trip_cause, self._manual, self._counts
        return {
            "now_ns": now_ns,
            "reason": trip.reason if trip is not None else "",
            "manual": "armed" if manual.armed(now_ns) else "returning" if manual.active else "off",
            "gain": float(self._stages.actuation.params["gain"][0]),
            "samples": counts.received,
            "commands": counts.commands,
            "clipped": counts.clipped,
            "magnetometer_errors": counts.magnetometer_errors,
            "tasks": self._scheduler.task_counts(),
        }
