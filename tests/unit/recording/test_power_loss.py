"""A power failure: what was synced is there, of the rest any page may be missing, and nothing false is read."""

from __future__ import annotations

import os
from pathlib import Path

import numpy as np
import pytest

from firmware_py.recording.errors import RecordingError
from firmware_py.recording.reader import Recording
from firmware_py.recording.writer import RecordingWriter
from tests.unit.recording.samples import COLUMNS, METADATA, make_rows, same_bits

PAGE = 4096


def test_what_was_synced_survives_and_nothing_false_appears(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    rows = make_rows(1200)
    path = tmp_path / "run.mcap"
    synced: list[tuple[int, int]] = [(0, 0)]  # bytes and blocks that a power failure cannot take
    sync = os.fdatasync

    def note(fd: int) -> None:
        sync(fd)
        synced.append((os.fstat(fd).st_size, len(sizes)))

    monkeypatch.setattr(os, "fdatasync", note)
    sizes: list[int] = []
    writer = RecordingWriter(path, COLUMNS, METADATA)
    for start in range(0, 1200, 100):
        writer.write_block(start, rows[start : start + 100])
        sizes.append(path.stat().st_size)
        if len(sizes) % 3 == 0:
            writer.sync()
    whole = path.read_bytes()
    assert len(synced) == 5
    rng = np.random.default_rng(8)
    lost = tmp_path / "lost.mcap"
    for _ in range(60):
        at = int(rng.integers(0, len(sizes)))
        size, blocks = max(s for s in synced if s[1] <= at + 1)
        left = bytearray(whole[: sizes[at]])  # as the program believes it to be
        for page in range(size // PAGE, len(left) // PAGE + 1):
            if rng.random() < 0.5:  # never written: zeros, from the first byte that was not synced on
                begin, end = max(size, page * PAGE), min(len(left), (page + 1) * PAGE)
                left[begin:end] = bytes(max(0, end - begin))
        if rng.random() < 0.3:
            del left[max(size, int(rng.integers(0, len(left)))) :]  # nor was the file's length
        lost.write_bytes(left)
        try:
            recording = Recording(lost)
        except RecordingError:
            assert size == 0
            continue
        numbers = recording.row_numbers()
        assert set(range(100 * blocks)) <= set(numbers.tolist())
        assert same_bits(recording.array(recording.names), rows[numbers])
        assert recording.health.lost
