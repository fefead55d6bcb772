"""Every tremor recording as one kind of object (``signal.TremorSignal``), whatever file it comes from.

A source is ``PATH[#NAME][#start:stop]``: a data set folder of ``../shared/data`` (one of ``DATA_SETS``), an .npz or
.csv whose columns end in their unit (``acc_x_g``, ``gyro_y_deg_s``, ``x_um``), or a recording of the contract (a .toml
or its folder). NAME picks one recording of a set (``9.8med``, ``23/gyro``), start:stop a part in seconds.
"""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

from tools.errors import InputError
from tools.research.tremor import signal_files, signal_sets
from tools.research.tremor.signal import TremorSignal

DATA_SETS = ("tremor_duke_adxl345", "tremor_paradigma_pd", "tremor_mouse_lsm9ds1")
SHORTEST_S = 4.0


def load_signals(source: str | Path) -> list[TremorSignal]:
    """Load all signals of ``source``. Raises InputError: what, where, what to do."""
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
    if not path.exists():
        raise InputError(f"{path}: there is no such file or folder")
    if path.is_dir() and path.name in DATA_SETS:
        return signal_sets.read_set(path)
    if path.is_file() and path.name == "data.npz" and path.parent.name in DATA_SETS:
        return signal_sets.read_set(path.parent)
    return signal_files.read_file(path)
