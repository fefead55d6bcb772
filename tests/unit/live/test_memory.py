"""The window into the loop: newest rows, honest about what a slow reader missed."""

from __future__ import annotations

import os

import numpy as np
import pytest

from firmware_py.live.memory import LiveMemory
from firmware_py.scheduler.histogram import DurationHistogram


@pytest.fixture
def ends():
    """The writer's and a reader's mapping of the same memory."""
    writer = LiveMemory.create(2, 64)
    reader = LiveMemory(os.dup(writer.fd))
    yield writer, reader
    reader.close()
    writer.close()


def push(memory: LiveMemory, first: int, n: int) -> None:
    for i in range(first, first + n):
        memory.push(np.array([i, -i], dtype=np.float64))


def test_a_reader_that_keeps_up_sees_every_row_once(ends: tuple[LiveMemory, LiveMemory]):
    writer, reader = ends
    seen: list[float] = []
    since = 0
    for start in range(0, 1000, 25):
        push(writer, start, 25)
        rows = reader.read(since)
        assert rows.missed == 0
        assert rows.first == since
        seen.extend(rows.values[:, 0])
        since = rows.first + len(rows.values)
    assert seen == list(range(1000))


def test_a_slow_reader_gets_the_newest_and_is_told_what_it_missed(ends: tuple[LiveMemory, LiveMemory]):
    writer, reader = ends
    push(writer, 0, 500)
    rows = reader.read(100)
    assert rows.missed == rows.first - 100 > 0
    np.testing.assert_array_equal(rows.values[:, 0], np.arange(rows.first, 500))
    assert len(rows.values) >= 48


def test_rows_overwritten_while_they_are_copied_are_thrown_away(ends: tuple[LiveMemory, LiveMemory]):
    writer, reader = ends
    push(writer, 0, 64)

    class Slow(np.ndarray):
        """Stored rows; the writer goes on while they are copied."""

        def __getitem__(self, key: object) -> np.ndarray:
            push(writer, 64, 30)
            return np.asarray(self)[key]  # type: ignore[index]

    reader._rows = reader._rows.view(Slow)  # pyright: ignore[reportPrivateUsage]
    rows = reader.read(0)
    np.testing.assert_array_equal(rows.values[:, 0], np.arange(rows.first, 64))
    assert rows.first == 64 + 30 - 64 + 1
    assert rows.missed == rows.first


def test_histograms_arrive_as_they_are(ends: tuple[LiveMemory, LiveMemory]):
    writer, reader = ends
    histogram = DurationHistogram()
    for i in range(1000):
        histogram.add(1000 * i, i)
    writer.put_histogram(3, histogram)
    writer.put_histogram(4, DurationHistogram())
    assert reader.distribution(3) == histogram.distribution()
    assert reader.distribution(4) == DurationHistogram().distribution()


def test_another_file_is_refused(tmp_path):
    path = tmp_path / "other"
    path.write_bytes(bytes(8192))
    with pytest.raises(ValueError, match="not the live memory"):
        LiveMemory(os.open(path, os.O_RDWR))
