"""Defines a fault: the disturbance, its place, and the correct response."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Any, Literal

Expected = Literal["safe state", "holds", "resumes", "noticed", "harmless", "refused", "cannot be seen", "any"]
LEFT_OUT = "the axis is left out once the others contradict it by seven deviations of their noise"


@dataclass(frozen=True)
class InWorld:
    """A fault of the emulated world (sim_devices.faults), ended by ``heal`` after ``for_s``."""

    fault: str
    target: str
    heal: str = ""
    for_s: float = 0.0


@dataclass(frozen=True)
class OnBus:
    """Middleware around the port of ``bus``; times of ``plan`` count from the strike. ``only``: one I2C address."""

    bus: str
    plan: Mapping[str, Any] = field(default_factory=dict[str, Any])
    only: int | None = None


@dataclass(frozen=True)
class OnHost:
    """The host does nothing for so long, as if another process had the processor."""

    stall_ms: float


@dataclass(frozen=True)
class Kill:
    """kill -9 of ``process``: firmware or guardian."""

    process: str


@dataclass(frozen=True)
class OutOfMemory:
    """The process may not map more than ``left_MB`` from the strike on."""

    left_MB: float


@dataclass(frozen=True)
class Both:
    """``second`` strikes ``gap_s`` after ``first``."""

    first: How
    second: How
    gap_s: float


How = InWorld | OnBus | OnHost | Kill | OutOfMemory | Both


@dataclass(frozen=True)
class Fault:
    """``names``: one of these must be in the message. ``at_start``: it is there before the bench is opened.

    ``redraws``: the fault also shifts when samples are taken, so they carry other noise; how far it takes the tip
    is seen without noise. ``own_output``: the fault itself moves the output, whatever the firmware says.
    ``slow``: this bench comes to know of it, but cannot within 20 ms; a bench that reads back can, and must.
    ``effect``: how much it disturbs a real bench, by the scale of the HIL tests (0 reads .. 4 motion); 9 is for the
    emulated world only. ``why``: for what cannot be seen, comes late or is harmless. ``redundant``: what is expected of
    a bench with more than six axes, where that is something else. ``part``: what a message says that isolates the
    fault, where that is more than one of ``names``.
    """

    name: str
    how: How
    expected: Expected
    names: tuple[str, ...] = ()
    watch_s: float = 0.15
    at_start: bool = False
    redraws: bool = False
    own_output: bool = False
    slow: bool = False
    effect: int = 9
    why: str = ""
    redundant: Expected | None = None
    part: str = ""
    is_pair: bool = False

    @property
    def part_of_bench(self) -> str:
        """The bus or device that is broken; empty for what is on every bench."""
        if isinstance(self.how, OnBus):
            return self.how.bus
        if isinstance(self.how, InWorld) and not self.how.target.isdigit():
            return self.how.target
        return ""

    @property
    def is_told_in_time(self) -> bool:
        """The bench has what it takes to know of it within 20 ms."""
        return self.expected != "cannot be seen" and not self.slow

    def with_read_back(self) -> Fault:
        """The same on a bench whose amplifier reads every command back."""
        return replace(self, slow=False)

    def with_redundancy(self) -> Fault:
        """The same on a bench that can do without an axis."""
        return self if self.redundant is None else replace(self, expected=self.redundant, why=LEFT_OUT)
