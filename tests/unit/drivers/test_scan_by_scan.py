"""Blocks, holes, wrap and times of a DAQ that sends scan by scan; its own bytes are its driver's matter."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, cast

import numpy as np

from drivers.daq.scan_by_scan import ScanByScan
from hal.clock import VirtualClock
from hal.types import ScanConfig, Status


class Script(ScanByScan):
    """Scans as they come; ``None``: nothing for now."""

    def __init__(self, *sequences: int | None) -> None:
        self.clock = VirtualClock()
        super().__init__(cast(Any, None), self.clock, "daq")
        self.left = list(sequences)
        self.configure(ScanConfig(1000.0, (0, 1), (5.0, 10.0)))
        self.start()

    def begin(self, config: ScanConfig) -> None: ...
    def stop(self) -> None: ...

    def next_scan(self, timeout_s: float) -> tuple[int, Sequence[int]] | None:
        sequence = self.left.pop(0) if self.left else None
        return None if sequence is None else (sequence, (sequence % 7, -sequence % 7))


def test_a_hole_ends_a_block_and_is_counted_in_the_next():
    daq, rows = Script(0, 1, 4, 5), np.zeros((8, 2), np.int16)
    daq.clock.advance_to(2_000_000)
    first = daq.read_scans(rows, 0.0)
    assert (first.n, first.seq0, first.lost, first.status) == (2, 0, 0, Status.OK)
    assert (first.t0_ns, first.dt_ns) == (1_000_000, 1_000_000)
    daq.clock.advance_to(6_000_000)
    second = daq.read_scans(rows, 0.0)
    assert (second.n, second.seq0, second.lost, second.status) == (2, 4, 2, Status.GAP)
    assert second.t0_ns == 5_000_000
    assert rows[:2].tolist() == [[4, 3], [5, 2]]


def test_the_sequence_number_wraps():
    daq, rows = Script(*range(65_534), 65_534, 65_535, 0, 1), np.zeros((65_540, 2), np.int16)
    block = daq.read_scans(rows, 0.0)
    assert (block.n, block.lost) == (65_538, 0)


def test_silence_is_an_empty_block():
    assert Script(None).read_scans(np.zeros((8, 2), np.int16), 0.0).n == 0
