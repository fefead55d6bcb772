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
from firmware_py.recording.format import Float64Array
from firmware_py.recording.reader import Recording


class ReplayRow(NamedTuple):
    """``inputs`` and ``recorded`` are the row's values of the two groups of columns, in their order."""

    number: int
    inputs: Float64Array
    recorded: Float64Array


@dataclass(frozen=True, slots=True)
class Mismatch:
    """The first value that is not the recorded one."""

    row: int
    column: str
    recorded: float
    replayed: float


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
        """JSON-ready; values as exact hexadecimal text besides the numbers."""
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


def replay_rows(recording: Recording, inputs: Sequence[str], outputs: Sequence[str]) -> Iterator[ReplayRow]:
    """The rows before the first gap, one by one. The arrays of a row are views that the next block replaces."""
    names = recording.names
    take = [_index(recording, names, name) for name in inputs]
    compare = [_index(recording, names, name) for name in outputs]
    next_row: int | None = None
    for block in recording.blocks():
        if next_row is None and block.row0 != 0:
            return
        if next_row is not None and block.row0 != next_row:
            return
        next_row = block.row0 + block.data.shape[1]
        given = np.ascontiguousarray(block.data[take].T)
        recorded = np.ascontiguousarray(block.data[compare].T)
        for i in range(len(given)):
            yield ReplayRow(block.row0 + i, given[i], recorded[i])


def replay(
    recording: Recording,
    step: Callable[[Float64Array], Float64Array],
    inputs: Sequence[str],
    outputs: Sequence[str],
) -> ReplayReport:
    """Run ``step(inputs[n_inputs]) -> outputs[n_outputs]`` over the recording and compare the bits.

    ``step`` may return a view of its own frame; NaN equals the same NaN, 0.0 is not -0.0.
    """
    rows = mismatching = 0
    first: Mismatch | None = None
    for row in replay_rows(recording, inputs, outputs):
        replayed = np.ascontiguousarray(step(row.inputs), dtype=np.float64)
        rows += 1
        different = replayed.view(np.uint64) != row.recorded.view(np.uint64)
        if different.any():
            mismatching += 1
            if first is None:
                at = int(np.argmax(different))
                first = Mismatch(row.number, outputs[at], float(row.recorded[at]), float(replayed[at]))
    return ReplayReport(rows, mismatching, first, recording.n_rows - rows)


def _index(recording: Recording, names: Sequence[str], name: str) -> int:
    try:
        return names.index(name)
    except ValueError:
        raise RecordingError(f"{recording.path} has no column {name!r}, which a replay needs") from None
