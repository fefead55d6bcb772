"""The instrument's task table: what runs in which tick, in which order, within which budget."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

from firmware_py.scheduler.task import TaskSpec, TickInfo

BUDGETS_US: Mapping[str, float] = {
    "sense": 60.0,
    "estimate": 50.0,
    "actuate": 520.0,  # 390 us of bus time at 400 kHz
    "publish": 30.0,
    "magnetometer": 330.0,  # 212 us of bus time
    "supervise": 300.0,
    "telemetry": 300.0,
    "verify": 340.0,  # 260 us of bus time
    "monitor": 330.0,  # 212 us of bus time
}
MAGNETOMETER_PHASES = (0, 3, 6)
VERIFY_PHASES = (1, 4, 8)  # in ticks that leave the bus free for it
MONITOR_PHASES = (1, 4, 7, 9)
MAY_WAIT_TICKS = 3
"""For what shares the bus with the outputs, and for telemetry: rather these a little late than the next command."""
VERIFY_BESIDE_MONITOR = (8,)  # tick 15 of 20 stays free for background work

Work = Callable[[TickInfo], object]


@dataclass(frozen=True)
class Works:
    """The work behind each name; ``None``: this bench has no device for it."""

    sense: Work
    estimate: Work
    actuate: Work
    publish: Work
    supervise: Work
    magnetometer: Work | None
    verify: Work | None
    monitor: Work | None
    telemetry: Work | None


def task_table(works: Works, tick_hz: int, budget_us: Mapping[str, float]) -> list[TaskSpec]:
    """Sense, estimate, actuate in every tick, then what can wait; ``budget_us`` overrides by name."""
    budget = {**BUDGETS_US, **budget_us}
    period_us = 1e6 / tick_hz

    def task(
        name: str,
        work: Work,
        order: int,
        divider: int = 1,
        phase: int = 0,
        *,
        catch_up: bool = False,
        may_wait: int = 0,
    ) -> None:
        limit_us = budget[name.partition("_")[0]]
        table.append(TaskSpec(name, work, divider, phase, order, limit_us, period_us, catch_up, may_wait))

    def in_turn(names: Sequence[str], work: Work | None, phases: Sequence[int]) -> None:
        for name, phase in zip(names, phases, strict=True):
            if work is not None:
                task(name, work, 4, 10, phase, may_wait=MAY_WAIT_TICKS)

    table: list[TaskSpec] = []
    task("sense", works.sense, 0, catch_up=True)
    task("estimate", works.estimate, 1, catch_up=True)
    task("actuate", works.actuate, 2)
    task("publish", works.publish, 3, catch_up=True)
    task("supervise", works.supervise, 5, 10, 2)
    in_turn([f"magnetometer_{axis}" for axis in "xyz"], works.magnetometer, MAGNETOMETER_PHASES)
    phases = VERIFY_PHASES if works.monitor is None else VERIFY_BESIDE_MONITOR
    in_turn([f"verify_{phase}" for phase in phases], works.verify, phases)
    in_turn([f"monitor_{phase}" for phase in MONITOR_PHASES], works.monitor, MONITOR_PHASES)
    if works.telemetry is not None:
        task("telemetry", works.telemetry, 6, 20, 5, may_wait=MAY_WAIT_TICKS)
    return table
