"""Feeds recorded inputs through the firmware's own steps and compares the results bit for bit.

Replay can be exact only up to the first row that the recording lacks: the live filters saw it, the replayed ones
cannot. Rows after a gap are therefore not compared; the report says where it stopped.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np

from firmware_py.recording.errors import RecordingError
from firmware_py.recording.reader import Recording
from hal.arrays import Array


class ReplayBlock(NamedTuple):
    """Rows ``number`` and following: ``inputs`` (n, n_inputs) and ``recorded`` (n, n_outputs), C order."""

    number: int
    inputs: Array
    recorded: Array


@dataclass(frozen=True, slots=True)
class Mismatch:
    """Describes the first value that differs from the recorded one."""

    row: int
    column: str
    recorded: float
    replayed: float

    def __str__(self) -> str:
        return f"row {self.row}, {self.column}: {self.recorded!r} recorded, {self.replayed!r} replayed"


@dataclass(frozen=True, slots=True)
class ReplayReport:
    """``rows`` were compared, ``mismatching_rows`` of them differ; ``left_out`` rows lie behind a gap."""

    rows: int
    mismatching_rows: int
    first: Mismatch | None
    left_out: int

    @property
    def identical(self) -> bool:
        return self.mismatching_rows == 0

    def as_dict(self) -> dict[str, Any]:
        """Return JSON values, with exact hexadecimal text besides the numbers."""
        first = None
        if self.first is not None:
            first = {
                "row": self.first.row,
                "column": self.first.column,
                "recorded": self.first.recorded,
                "replayed": self.first.replayed,
                "recorded_hex": float(self.first.recorded).hex(),
                "replayed_hex": float(self.first.replayed).hex(),
            }
        return {
            "rows": self.rows,
            "mismatching_rows": self.mismatching_rows,
            "identical": self.identical,
            "first_mismatch": first,
            "left_out": self.left_out,
        }


def replay_blocks(recording: Recording, inputs: Sequence[str], outputs: Sequence[str]) -> Iterator[ReplayBlock]:
    """The rows before the first gap, as they were recorded; one block of memory at a time."""
    names = recording.names
    take = [_index(recording, names, name) for name in inputs]
    compare = [_index(recording, names, name) for name in outputs]
    next_row = 0
    for block in recording.blocks():
        if block.row0 != next_row:
            return
        next_row = block.row0 + block.data.shape[1]
        yield ReplayBlock(
            block.row0, np.ascontiguousarray(block.data[take].T), np.ascontiguousarray(block.data[compare].T)
        )


def replay(
    recording: Recording,
    run: Callable[[Array], Array],
    inputs: Sequence[str],
    outputs: Sequence[str],
) -> ReplayReport:
    """Run ``run(inputs (n, n_inputs)) -> outputs (n, n_outputs)`` over the recording and compare the bits.

    ``run`` gets the rows in order, a few at a time, and remembers what it must. NaN equals the same NaN, 0.0 is
    not -0.0.
    """
    rows = mismatching = 0
    first: Mismatch | None = None
    for block in replay_blocks(recording, inputs, outputs):
        replayed = np.ascontiguousarray(run(block.inputs), dtype=np.float64)
        rows += len(replayed)
        different = replayed.view(np.uint64) != block.recorded.view(np.uint64)
        if different.any():
            mismatching += int(np.count_nonzero(different.any(axis=1)))
            if first is None:
                row, at = (int(i) for i in np.argwhere(different)[0])
                recorded, found = float(block.recorded[row, at]), float(replayed[row, at])
                first = Mismatch(block.number + row, outputs[at], recorded, found)
    return ReplayReport(rows, mismatching, first, recording.n_rows - rows)


def _index(recording: Recording, names: Sequence[str], name: str) -> int:
    try:
        return names.index(name)
    except ValueError:
        raise RecordingError(f"{recording.path} has no column {name!r}, which a replay needs") from None
