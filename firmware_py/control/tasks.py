"""Lists the instrument's tasks: one row each, in the order in which they run."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Protocol

from drivers.polling import SUPERVISE
from drivers.polls import Polling
from firmware_py.run.tasks import EVERY_TICK, TaskRow
from firmware_py.scheduler.task import TickInfo

MAY_WAIT_TICKS = 3
"""Ticks for which telemetry, and tasks that share the bus with the outputs, may be deferred: they may be a little
late, the next command may not."""


class Works(Protocol):
    """Does the work of each task."""

    def sense(self, info: TickInfo) -> None: ...
    def estimate(self, info: TickInfo) -> None: ...
    def actuate(self, info: TickInfo) -> None: ...
    def publish(self, info: TickInfo) -> None: ...
    def supervise(self, info: TickInfo) -> None: ...
    def verify(self, info: TickInfo) -> None: ...
    def monitor(self, info: TickInfo) -> None: ...
    def magnetometer(self, info: TickInfo) -> None: ...
    def telemetry(self, info: TickInfo) -> None: ...


def task_rows(works: Works, polling: Polling, bus_us: Mapping[str, float]) -> list[TaskRow]:
    """Return the table of the instrument's tasks. ``bus_us`` is the time that a task's transaction takes on the wires,
    us; the other part of a budget is an allowance for the processor.

    The allowance of 100 us for a transfer is 1.4 to 3 times the median of a driver and its emulated device together (35
    to 70 us on the two-core machine of the benchmarks, column ``cpu`` of a run in virtual time).
    """
    wait = MAY_WAIT_TICKS
    rows = (
        TaskRow("sense", works.sense, EVERY_TICK, 60.0, catch_up=True),
        TaskRow("estimate", works.estimate, EVERY_TICK, 50.0, catch_up=True),
        TaskRow("actuate", works.actuate, EVERY_TICK, 100.0),
        TaskRow("publish", works.publish, EVERY_TICK, 30.0, catch_up=True),
        TaskRow("supervise", works.supervise, SUPERVISE, 300.0, phase=2),
        TaskRow("verify", works.verify, polling.verify, 100.0, phase=8, deferrable=wait),
        TaskRow("monitor", works.monitor, polling.monitor, 100.0, phase=0, deferrable=wait),
        TaskRow("magnetometer", works.magnetometer, polling.magnetometer, 100.0, phase=0, deferrable=wait),
        TaskRow("telemetry", works.telemetry, polling.telemetry, 300.0, phase=5, deferrable=wait),
    )
    return [row.with_bus(bus_us.get(row.name, 0.0)) for row in rows]
