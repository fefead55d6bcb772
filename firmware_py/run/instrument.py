"""States what the loop needs to know of an instrument: before its devices are opened, opened, and in a run."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from contextlib import AbstractContextManager
from typing import Any, Protocol

from firmware_py.run.context import Run
from firmware_py.run.safety import SafetyLimits, SelfTestLimits
from firmware_py.run.tasks import TaskRow
from firmware_py.scheduler.histogram import DurationHistogram
from firmware_py.scheduler.ticker import Ticks
from hal.bench import BenchFile, OpenBench
from hal.contracts import AnalogOutput


class InstrumentPlan(Protocol):
    """Defines a bench file that is resolved for an instrument, before a device is touched."""

    @property
    def bench(self) -> BenchFile: ...
    @property
    def safety(self) -> SafetyLimits: ...

    def open(self, opened: OpenBench) -> OpenedInstrument:
        """Open and probe every device. Raises ``BenchError`` or ``OpenFailed``."""
        ...


class OpenedInstrument(Protocol):
    """Defines an instrument whose devices are configured and not yet running. ``identities`` are the answers of the
    probes by device, ``output`` moves the actuators, ``columns`` are names and units of the rows that are recorded."""

    @property
    def identities(self) -> dict[str, str]: ...
    @property
    def output(self) -> AnalogOutput | None: ...
    @property
    def columns(self) -> Sequence[tuple[str, str]]: ...

    def metadata(self) -> dict[str, str]:
        """Return what a recording keeps so that the run can be replayed."""
        ...

    def assemble(self, run: Run) -> Instrument:
        """Return the instrument that runs in ``run``, whose output may stand behind a guardian now."""
        ...


class Instrument(Protocol):
    """Defines a running instrument. ``tasks`` is its table, ``budget_us`` the bench file's own budgets.

    ``self_test`` is ``None`` for an instrument that runs at once. ``closers`` are called in turn at the end, and may
    raise ``HalError``.
    """

    @property
    def tasks(self) -> Sequence[TaskRow]: ...
    @property
    def budget_us(self) -> dict[str, float]: ...
    @property
    def self_test(self) -> SelfTestLimits | None: ...
    @property
    def closers(self) -> Sequence[Callable[[], object]]: ...

    def prepare(self) -> None:
        """Prepare what needs ``Run.scheduler`` or takes long; called once, before real-time settings are made."""
        ...

    def running(self) -> AbstractContextManager[object]:
        """Return the context in which the whole run takes place."""
        ...

    def start(self) -> None:
        """Start the devices; may set ``Run.started_ns``, which is now, to a later time."""
        ...

    def wait(self) -> Ticks | None:
        """Wait for the next ticks and return them. Return ``None`` if the supervisor must not wait any more
        (``must_not_wait``). Raises ``HalError`` if a read fails and has ended the run."""
        ...

    def poll(self) -> Ticks | None:
        """Return the ticks that have become due, without waiting; called while the outputs are being armed."""
        ...

    def inspect_ticks(self, ticks: Ticks) -> None:
        """Report findings about the arrival of ``ticks`` (late, missing, without scan), before their tasks run."""
        ...

    def rest(self) -> None:
        """Do the work that is allowed only during a hold; called once per pass of the loop while one lasts."""
        ...

    def repair(self) -> None:
        """Start failed devices again; called once per pass while nothing moves."""
        ...

    def waiting_for(self) -> list[str]:
        """Return the conditions that prevent arming, for the first time or after a hold."""
        ...

    def numbers(self) -> dict[str, object]:
        """Return a few numbers for display, as JSON values, beside those of every run."""
        ...

    def histograms(self) -> dict[str, DurationHistogram]:
        """Return histograms for the page, beside those of the tasks."""
        ...

    def report(self) -> dict[str, Any]:
        """Return the instrument's own part of the outcome, as JSON values."""
        ...
