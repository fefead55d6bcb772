"""Cooperative scheduler of the firmware: task table, time bases, slack, statistics, real-time settings.

What lives here: who runs in a tick and in what is left of it, and how long that took; nothing that knows a device.
What must not: the tasks themselves (``firmware_py.control``), waiting for anything but the next tick.
"""

from firmware_py.scheduler.histogram import Distribution, DurationHistogram
from firmware_py.scheduler.realtime import RealtimeConfig, RealtimeReport, realtime
from firmware_py.scheduler.scheduler import Scheduler
from firmware_py.scheduler.statistics import SchedulerSnapshot, TaskSnapshot
from firmware_py.scheduler.task import BackgroundSpec, TaskSpec, TickInfo
from firmware_py.scheduler.ticker import HostTicker, ScanTicker, Ticker, Ticks

__all__ = [
    "BackgroundSpec",
    "Distribution",
    "DurationHistogram",
    "HostTicker",
    "RealtimeConfig",
    "RealtimeReport",
    "ScanTicker",
    "Scheduler",
    "SchedulerSnapshot",
    "TaskSnapshot",
    "TaskSpec",
    "TickInfo",
    "Ticker",
    "Ticks",
    "realtime",
]
