"""Recordings that another program has copied: every row bit for bit, or one clear error, and ``recover`` agrees."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from mcap.writer import CompressionType

from firmware_py.exit_codes import Exit
from firmware_py.recording import format as fmt
from firmware_py.recording.errors import RecordingError
from firmware_py.recording.health import RowGap, TickGap
from firmware_py.recording.reader import Recording
from firmware_py.recording.recover import recover
from firmware_py.recording.replay import replay
from firmware_py.recording.writer import RecordingWriter
from tests.unit.recording.copies import Order, copy
from tests.unit.recording.samples import COLUMNS, make_rows, same_bits

WriteFile = Callable[..., tuple[Path, np.ndarray]]
CHUNK_BYTES = (1, 1 << 12, 1 << 14, 1 << 20, 1 << 24)
"""One message a chunk, smaller than a block, ours, the default of the package, and everything in one chunk."""


def assert_equal(copied: Path, original: Path, rows: np.ndarray) -> None:
    recording, source = Recording(copied), Recording(original)
    assert same_bits(recording.array(recording.names), rows)
    assert recording.row_numbers().tolist() == list(range(len(rows)))
    assert [(e.number, e.time_ns, e.content) for e in recording.events] == [
        (e.number, e.time_ns, e.content) for e in source.events
    ]
    assert recording.metadata == source.metadata
    assert not recording.health.lost, recording.health.lines()
    for name in ("missing_rows", "missing_ticks", "first_tick", "last_tick", "last_time_s", "tick_gaps", "row_gaps"):
        assert getattr(recording.health, name) == getattr(source.health, name)
    report = recover(copied, copied.with_name("recovered.mcap"), overwrite=True)
    assert report.exit_code == Exit.DONE
    assert "nothing is missing" in report.lines()[-1]
    assert same_bits(Recording(report.out).array(recording.names), rows)


@pytest.mark.parametrize("chunk_bytes", CHUNK_BYTES)
@pytest.mark.parametrize("compression", list(CompressionType))
def test_every_row_of_a_copy_with_other_chunks(
    write_file: WriteFile, tmp_path: Path, chunk_bytes: int, compression: CompressionType
) -> None:
    path, rows = write_file(1037)
    assert_equal(copy([path], tmp_path / "c.mcap", chunk_bytes=chunk_bytes, compression=compression), path, rows)


@pytest.mark.parametrize("order", ["file", "time", "shuffled", "reversed"])
@pytest.mark.parametrize("metadata", ["first", "last"])
@pytest.mark.parametrize("chunk_bytes", [1 << 13, 1 << 20])
def test_every_row_of_a_reordered_copy(
    write_file: WriteFile, tmp_path: Path, order: Order, metadata: str, chunk_bytes: int
) -> None:
    path, rows = write_file(1037)
    copied = copy([path], tmp_path / "c.mcap", chunk_bytes=chunk_bytes, order=order, metadata=metadata)  # type: ignore[arg-type]
    assert_equal(copied, path, rows)


def test_a_recording_merged_with_itself_or_with_what_was_recovered_of_it_counts_once(
    write_file: WriteFile, tmp_path: Path
) -> None:
    path, rows = write_file(700)
    assert_equal(copy([path, path], tmp_path / "twice.mcap"), path, rows)
    torn = tmp_path / "torn.mcap"
    torn.write_bytes(path.read_bytes()[: path.stat().st_size // 2])
    recovered = recover(torn, tmp_path / "r.mcap").out
    merged = Recording(copy([recovered, path], tmp_path / "m.mcap", metadata="none"))
    assert same_bits(merged.array(merged.names), rows)
    assert merged.health.missing_rows == 0
    assert len(merged.events) == len(Recording(path).events)


def test_two_different_recordings_in_one_file_are_one_clear_error(write_file: WriteFile, tmp_path: Path) -> None:
    path, _ = write_file(300)
    other = tmp_path / "other.mcap"
    writer = RecordingWriter(other, COLUMNS, {})
    writer.write_block(150, make_rows(100, seed=9, first=150))
    writer.finish({"ended": "stopped", "rows_pushed": 250})
    merged = copy([path, other], tmp_path / "m.mcap")
    with pytest.raises(RecordingError, match="two different versions of row 150: it was made of several recordings"):
        Recording(merged)
    with pytest.raises(RecordingError, match="two different versions of row 150"):
        recover(merged, tmp_path / "r.mcap")
    assert not (tmp_path / "r.mcap").exists()
    strange = tmp_path / "strange.mcap"
    writer = RecordingWriter(strange, [("tick", "1"), ("speed", "m/s")], {})
    writer.write_block(300, make_rows(100)[:, :2])
    writer.finish({"ended": "stopped", "rows_pushed": 400})
    with pytest.raises(RecordingError, match="a block was written with another layout than the file's"):
        Recording(copy([path, strange], tmp_path / "m2.mcap"))


def test_a_block_of_another_layout_is_refused_by_its_crc(tmp_path: Path) -> None:
    """Two layouts of one length: only the CRC of the layout in the block tells volts from millivolts."""
    paths = []
    for row0, unit in enumerate(("V", "mV")):
        writer = RecordingWriter(tmp_path / f"{unit}.mcap", [("x", unit)], {})
        writer.write_block(row0, np.array([[1.0]]))
        writer.finish({"ended": "stopped", "rows_pushed": row0 + 1})
        paths.append(tmp_path / f"{unit}.mcap")
    with pytest.raises(RecordingError, match="a block was written with another layout than the file's"):
        Recording(copy(paths, tmp_path / "m.mcap", metadata="none"))
    block = fmt.encode_block(0, np.array([[1.0]]), 123)
    with pytest.raises(RecordingError, match="another layout"):
        fmt.decode_block(block, 124, 1)


def test_metadata_of_two_recordings_is_damage_and_the_first_counts(write_file: WriteFile, tmp_path: Path) -> None:
    first, rows = write_file(100)
    second = tmp_path / "second.mcap"
    writer = RecordingWriter(second, COLUMNS, {"bench": "another"})
    writer.write_block(100, make_rows(200, seed=4)[100:])
    writer.finish({"ended": "stopped", "rows_pushed": 200})
    recording = Recording(copy([first, second], tmp_path / "m.mcap"))
    assert same_bits(recording.array(recording.names)[:100], rows)
    assert recording.metadata["bench"] == Recording(first).metadata["bench"]
    assert recording.health.lost
    assert any("'bench': it is there twice" in line for line in recording.health.lines())


def test_a_copy_of_one_topic_says_what_it_lacks(write_file: WriteFile, tmp_path: Path) -> None:
    path, rows = write_file(500)
    ticks = Recording(copy([path], tmp_path / "ticks.mcap", topics=("ticks",)))
    assert same_bits(ticks.array(ticks.names), rows)
    assert (ticks.health.missing_rows, ticks.health.missing_events, ticks.health.lost) == (0, 2, True)
    events = Recording(copy([path], tmp_path / "events.mcap", topics=("events",)))
    assert (events.n_rows, events.health.missing_rows, len(events.events)) == (0, 500, 2)
    assert events.array(events.names).shape == (0, 5)


def test_a_copy_without_metadata_does_not_blame_the_recorder(write_file: WriteFile, tmp_path: Path) -> None:
    path, rows = write_file(500)
    copied = copy([path], tmp_path / "c.mcap", metadata="none")
    recording = Recording(copied)
    assert same_bits(recording.array(recording.names), rows)
    said = "\n".join(recording.health.lines())
    assert "another program has copied it without its metadata" in said
    assert "killed" not in said
    report = recover(copied, tmp_path / "r.mcap")
    assert report.exit_code == Exit.DATA_LOST
    assert Recording(report.out).health.ended.endswith("whether ticks are missing at the end is not known")


def test_a_copy_of_the_later_part_lacks_the_first_rows(write_file: WriteFile, tmp_path: Path) -> None:
    path, rows = write_file(500)
    recording = Recording(copy([path], tmp_path / "c.mcap", from_ns=250_000_000))
    assert recording.health.row_gaps == (RowGap(0, 200),)
    assert same_bits(recording.array(recording.names), rows[200:])


def test_messages_without_a_checksum_are_not_read_and_it_is_said_once(write_file: WriteFile, tmp_path: Path) -> None:
    path, _ = write_file(500)
    for copied, says in (
        (copy([path], tmp_path / "loose.mcap", chunked=False), "7 messages outside chunks have no checksum"),
        (copy([path], tmp_path / "bare.mcap", crcs=False, chunk_bytes=1 << 14), "it has no CRC"),
    ):
        recording = Recording(copied)
        assert (recording.n_rows, recording.health.missing_rows, recording.health.lost) == (0, 500, True)
        assert says in "\n".join(recording.health.lines())


def test_gaps_of_the_instrument_in_a_shuffled_copy(tmp_path: Path) -> None:
    rows = make_rows(400)
    rows[150:, 0] += 5  # inside a block
    rows[300:, 0] += 2  # between two blocks
    path = tmp_path / "gaps.mcap"
    writer = RecordingWriter(path, COLUMNS, {})
    for row0, part in ((0, rows[:100]), (100, rows[100:200]), (230, rows[230:300]), (300, rows[300:])):
        writer.write_block(row0, part)
    writer.finish({"ended": "stopped", "rows_pushed": 410, "rows_dropped": 30})
    health = Recording(copy([path], tmp_path / "c.mcap", order="shuffled")).health
    assert health.row_gaps == (RowGap(200, 30), RowGap(400, 10))
    assert health.tick_gaps == (TickGap(149, 155), TickGap(304, 307))
    assert (health.missing_ticks, health.missing_rows, health.first_tick, health.last_tick) == (7, 40, 0, 406)
    assert health.last_time_s == rows[-1, 1]


def test_replay_runs_over_all_rows_of_a_copy(write_file: WriteFile, tmp_path: Path) -> None:
    path, _ = write_file(1000)
    copied = Recording(copy([path], tmp_path / "c.mcap"))
    report = replay(copied, lambda inputs: inputs.copy(), ["volts_0"], ["volts_0"])
    assert (report.rows, report.left_out, report.identical) == (1000, 0, True)
    wrong = replay(copied, lambda inputs: inputs + 1.0, ["tick"], ["tick"])
    assert wrong.mismatching_rows == 1000
