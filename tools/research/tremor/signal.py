"""A tremor recording as everybody sees it: uniform samples in SI, the true rate, what is known beside them."""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from hal.arrays import Array
from tools.errors import InputError


@dataclass(frozen=True)
class Windows:
    """Reference results per window: all (w,). ``frequency_hz`` is of any window, tremor or not."""

    start_s: Array
    length_s: float
    tremor: NDArray[np.bool_]
    frequency_hz: Array
    at_rest: NDArray[np.bool_]
    power: Array  # (deg/s)^2 in the source's tremor band


@dataclass(frozen=True)
class Reference:
    """Holds the known facts beside the signal itself; an unknown one is ``None``."""

    drive_hz: float | None = None
    amplitude: str = ""  # low, med, high of a shaker
    tremor: bool | None = None  # the person's diagnosis, or a still table
    windows: Windows | None = None


@dataclass(frozen=True)
class TremorSignal:
    """``values`` (n, k) in ``unit`` (SI; pixel for a cursor), sample i at ``start_s`` + i / ``rate_hz``.

    ``rate_hz`` is the best that is known of the clock, ``stated_rate_hz`` what the source says. ``notes``: what was
    found or mended.
    """

    name: str
    data_set: str
    subject: str
    quantity: str
    unit: str
    axes: tuple[str, ...]
    values: Array
    rate_hz: float
    stated_rate_hz: float
    start_s: float = 0.0
    reference: Reference = field(default_factory=Reference)
    notes: tuple[str, ...] = ()

    @property
    def seconds(self) -> float:
        return len(self.values) / self.rate_hz

    @property
    def t_s(self) -> Array:
        """(n,)"""
        return self.start_s + np.arange(len(self.values)) / self.rate_hz

    def part(self, start_s: float, stop_s: float) -> TremorSignal:
        """Return the part from ``start_s`` to ``stop_s`` after its own beginning; reference windows are kept."""
        first, last = round(start_s * self.rate_hz), round(stop_s * self.rate_hz)
        if not 0 <= first < last <= len(self.values):
            raise InputError(f"{self.name}: part {start_s:g}:{stop_s:g} s, but it is {self.seconds:.2f} s long")
        return replace(self, values=self.values[first:last], start_s=self.start_s + first / self.rate_hz)
