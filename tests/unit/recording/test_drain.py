"""The recorder's inner loop in virtual time: when blocks are closed, and how gaps are kept."""

from __future__ import annotations

import json
import os
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

from firmware_py.recording.drain import OPEN_BLOCK_S, Drain
from firmware_py.recording.health import RowGap
from firmware_py.recording.reader import Recording
from firmware_py.recording.ring import EventRing, RowRing
from firmware_py.recording.writer import RecordingWriter

COLUMNS = [("tick", "1"), ("t", "s")]


class Stand:
    def __init__(self, path: Path) -> None:
        self.path = path
        self.rows = RowRing.create(2, 300)
        self.events = EventRing.create(4096)
        self.taken_rows = RowRing(os.dup(self.rows.fd))
        self.taken_events = EventRing(os.dup(self.events.fd))
        self.writer = RecordingWriter(path, COLUMNS, {})
        self.drain = Drain(self.taken_rows, self.taken_events, self.writer)
        self.k = 0

    def push(self, n: int) -> None:
        for _ in range(n):
            self.rows.push(np.array([self.k, self.k * 1e-3]))
            self.k += 1

    def in_file(self) -> int:
        """Rows that a reader finds now, while the file is being written."""
        return Recording(self.path).n_rows

    def close(self) -> None:
        for ring in (self.rows, self.events, self.taken_rows, self.taken_events):
            ring.close()


@pytest.fixture
def stand(tmp_path: Path) -> Iterator[Stand]:
    stand = Stand(tmp_path / "run.mcap")
    yield stand
    stand.close()


def test_a_block_is_in_the_file_when_its_hundredth_row_was_taken(stand: Stand) -> None:
    stand.push(99)
    stand.drain.step(now_s=0.0)
    assert stand.in_file() == 0
    stand.push(1)
    stand.drain.step(now_s=0.001)
    assert stand.in_file() == 100
    assert (stand.rows.written, stand.rows.waiting()) == (100, 0)


def test_a_block_is_closed_when_it_has_been_open_for_too_long(stand: Stand) -> None:
    stand.drain.step(now_s=0.0)
    stand.push(7)
    stand.drain.step(now_s=0.0)
    stand.push(7)
    stand.drain.step(now_s=OPEN_BLOCK_S - 0.001)
    assert stand.in_file() == 0
    stand.drain.step(now_s=OPEN_BLOCK_S)
    assert stand.in_file() == 14


def test_an_event_alone_reaches_the_file_as_soon(stand: Stand) -> None:
    stand.events.push(json.dumps({"event": "alone"}).encode())
    stand.drain.step(now_s=0.0)
    assert Recording(stand.path).events == []
    stand.drain.step(now_s=OPEN_BLOCK_S)
    assert [e.content for e in Recording(stand.path).events] == [{"event": "alone"}]


def test_dropped_rows_are_a_gap_in_the_right_place(stand: Stand) -> None:
    stand.push(350)  # 50 more than the ring holds
    stand.drain.drain()
    stand.push(30)
    stand.drain.drain()
    stand.writer.finish(stand.drain.totals("stopped"))
    recording = Recording(stand.path)
    assert recording.row_numbers().tolist() == [*range(300), *range(350, 380)]
    assert recording.column("tick").tolist() == [*range(300), *range(350, 380)]
    assert recording.health.row_gaps == (RowGap(300, 50),)
    assert (recording.health.dropped, recording.health.missing_rows) == (50, 50)
    assert stand.drain.totals("stopped")["rows_pushed"] == 380


def test_a_drop_in_the_last_row_is_known_from_the_totals(stand: Stand) -> None:
    stand.push(310)
    stand.drain.drain()
    stand.writer.finish(stand.drain.totals("stopped"))
    assert Recording(stand.path).health.row_gaps == (RowGap(300, 10),)


def test_a_recording_without_rows_is_whole(stand: Stand) -> None:
    stand.drain.drain()
    stand.writer.finish(stand.drain.totals("stopped"))
    recording = Recording(stand.path)
    assert (recording.n_rows, recording.health.lost) == (0, False)
    assert recording.array(["tick"]).shape == (0, 1)
