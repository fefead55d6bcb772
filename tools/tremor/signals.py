"""Every tremor recording, one kind of object: uniform samples in SI, the true rate, what is known about it.

A source is ``PATH[#NAME][#start:stop]``: a data set folder of ``../shared/data`` (one of ``DATA_SETS``), an .npz or
.csv whose columns end in their unit (``acc_x_g``, ``gyro_y_deg_s``, ``x_um``), or a recording of the contract (a .toml
or its folder). NAME picks one recording of a set (``9.8med``, ``23/gyro``), start:stop a part in seconds.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from tools.errors import InputError

Array = NDArray[np.float64]

DATA_SETS = ("tremor_duke_adxl345", "tremor_paradigma_pd", "tremor_mouse_lsm9ds1")
SHORTEST_S = 4.0


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
    """What is known beside the signal itself; absent knowledge is ``None``."""

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
        """From ``start_s`` to ``stop_s`` after its own beginning; reference windows stay as they are."""
        first, last = round(start_s * self.rate_hz), round(stop_s * self.rate_hz)
        if not 0 <= first < last <= len(self.values):
            raise InputError(f"{self.name}: part {start_s:g}:{stop_s:g} s, but it is {self.seconds:.2f} s long")
        return replace(self, values=self.values[first:last], start_s=self.start_s + first / self.rate_hz)


def load_signals(source: str | Path) -> list[TremorSignal]:
    """All signals of ``source``. Raises InputError: what, where, what to do."""
    path, name, part = _address(str(source))
    signals = list(_read(path))
    if name:
        chosen = [s for s in signals if name in (s.name, s.name.split("/", 1)[-1], s.subject)]
        if not chosen:
            known = ", ".join(s.name.split("/", 1)[-1] for s in signals[:60])
            raise InputError(f"{path}: no recording '{name}'; it holds: {known}")
        signals = chosen
    if part is not None:
        signals = [s.part(*part) for s in signals]
    for s in signals:
        if s.seconds < SHORTEST_S:
            raise InputError(f"{s.name}: {s.seconds:.2f} s; at least {SHORTEST_S:g} s are needed to tell a frequency")
        if s.rate_hz < 30.0:
            raise InputError(f"{s.name}: sampled at {s.rate_hz:.1f} Hz; tremor up to 12 Hz needs 30 Hz or more")
    return signals


def load_data_sets(data: Path) -> list[TremorSignal]:
    """Every tremor recording of the folder ``data`` (``../shared/data``), in a fixed order."""
    return [s for name in DATA_SETS if (data / name).is_dir() for s in load_signals(data / name)]


def _address(source: str) -> tuple[Path, str, tuple[float, float] | None]:
    pieces = source.split("#")
    name, part = "", None
    for piece in pieces[1:]:
        if ":" not in piece:
            name = piece
            continue
        try:
            start, stop = (float(v) for v in piece.split(":"))
        except ValueError:
            raise InputError(f"'#{piece}': a part is #start:stop in seconds, for example #10:40") from None
        part = start, stop
    return Path(pieces[0]), name, part


def _read(path: Path) -> Iterator[TremorSignal]:
    from tools.tremor import signal_files, signal_sets

    if not path.exists():
        raise InputError(f"{path}: there is no such file or folder")
    if path.is_dir() and path.name in DATA_SETS:
        return signal_sets.read_set(path)
    if path.is_file() and path.name == "data.npz" and path.parent.name in DATA_SETS:
        return signal_sets.read_set(path.parent)
    return signal_files.read_file(path)
