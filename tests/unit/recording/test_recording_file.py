"""Files: round trip, truncation, damage. Positions of chunks come from mcap's own index, not from our reader."""

from __future__ import annotations

import json
import struct
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from mcap.reader import make_reader

from firmware_py.recording.errors import RecordingError
from firmware_py.recording.health import RowGap, TickGap
from firmware_py.recording.reader import Recording
from firmware_py.recording.writer import RecordingWriter
from tests.unit.recording.samples import COLUMNS, METADATA, make_rows, same_bits

WriteFile = Callable[..., tuple[Path, np.ndarray]]


def chunk_ends(path: Path) -> list[int]:
    with path.open("rb") as file:
        summary = make_reader(file).get_summary()
    assert summary is not None
    return [index.chunk_start_offset + index.chunk_length for index in summary.chunk_indexes]


def test_round_trip_keeps_every_bit(write_file: WriteFile) -> None:
    path, rows = write_file(1037)
    recording = Recording(path)
    assert recording.columns == tuple(COLUMNS)
    assert recording.unit("volts_0") == "V"
    assert same_bits(recording.array(recording.names), rows)
    assert same_bits(recording.column("volts_0"), rows[:, 2])
    assert same_bits(recording.arrays()["status"], rows[:, 4])
    assert recording.row_numbers().tolist() == list(range(1037))
    assert {k: recording.metadata[k] for k in METADATA} == METADATA
    assert recording.metadata["statistics"] == {"ticks": 1037}
    assert [(e.number, e.content) for e in recording.events] == [
        (0, {"event": "mark", "t_ns": 100}),
        (1, {"event": "mark", "t_ns": 400}),
        (2, {"event": "mark", "t_ns": 700}),
        (3, {"event": "mark", "t_ns": 1000}),
    ]
    health = recording.health
    assert (health.rows, health.expected_rows, health.first_tick, health.last_tick) == (1037, 1037, 0, 1036)
    assert health.last_time_s == 1.036
    assert not health.lost


def test_a_stranger_can_decode_it_from_the_document(write_file: WriteFile) -> None:
    """Written from docs/recording-format.md with mcap's ordinary reader, without our decoder."""
    path, rows = write_file(300)
    decoded = []
    with path.open("rb") as file:
        reader = make_reader(file)
        for schema, channel, message in reader.iter_messages(topics=["ticks"]):
            assert channel.message_encoding == "x-micron-ticks"
            assert schema is not None
            names = [entry["name"] for entry in json.loads(schema.data)["x-layout"]]
            magic, n_columns, n_rows, _crc, first = struct.unpack_from("<4sIIIQ", message.data)
            assert (magic, n_columns, first) == (b"MTB1", len(names), message.sequence * 100)
            body = message.data[24:]
            n = n_columns * n_rows
            values = [bytes(body[byte * n + i] for byte in range(8)) for i in range(n)]
            columns = np.array([struct.unpack("<d", v)[0] for v in values]).reshape(n_columns, n_rows)
            decoded.append(columns.T)
            assert message.publish_time == round(columns[1, 0] * 1e9)
            assert message.log_time == round(columns[1, -1] * 1e9)
        texts = {m.name: m.metadata["text"] for m in reader.iter_metadata()}
        events = [json.loads(m.data) for _, _, m in reader.iter_messages(topics=["events"])]
    finite = np.isfinite(rows)
    assert np.array_equal(np.concatenate(decoded)[finite], rows[finite])
    assert texts["bench"] == METADATA["bench"]
    assert json.loads(texts["layout"]) == [{"name": n, "unit": u} for n, u in COLUMNS]
    assert events == [{"event": "mark", "t_ns": 100}]


def test_every_block_is_a_chunk_of_its_own(write_file: WriteFile) -> None:
    path, _ = write_file(1000)
    assert len(chunk_ends(path)) == 10


def test_truncated_anywhere_every_finished_block_is_there_and_nothing_false(
    write_file: WriteFile, tmp_path: Path
) -> None:
    path, rows = write_file(700)
    whole = path.read_bytes()
    ends = chunk_ends(path)
    torn = tmp_path / "torn.mcap"
    first_chunk_end = ends[0]
    rng = np.random.default_rng(5)
    near_edges = [end + d for end in ends for d in (-1, 0, 1, 8, 9, 10)]
    for offset in [*near_edges, *rng.integers(first_chunk_end, len(whole), 100).tolist()]:
        torn.write_bytes(whole[:offset])
        recording = Recording(torn)
        blocks = sum(end <= offset for end in ends)
        assert recording.n_rows == 100 * blocks, offset
        assert same_bits(recording.array(recording.names), rows[: 100 * blocks])
        assert recording.health.lost
        assert recording.health.last_tick == (100 * blocks - 1 if blocks else None)


def test_truncated_before_the_first_block_it_is_empty_or_no_recording(write_file: WriteFile, tmp_path: Path) -> None:
    path, _ = write_file(200)
    whole = path.read_bytes()
    torn = tmp_path / "torn.mcap"
    layout_end = whole.index(b"bench")  # the layout is the first text, the bench description the second
    for offset in range(0, chunk_ends(path)[0], 29):
        torn.write_bytes(whole[:offset])
        if offset > layout_end:
            assert Recording(torn).n_rows == 0
        elif offset < layout_end - 20:
            with pytest.raises(RecordingError, match="is not a recording"):
                Recording(torn)


def test_no_flipped_bit_goes_unnoticed(write_file: WriteFile, tmp_path: Path) -> None:
    path, rows = write_file(300)
    whole = Recording(path)
    truth = [(e.number, e.content) for e in whole.events]
    data = path.read_bytes()
    flipped = tmp_path / "flipped.mcap"
    rng = np.random.default_rng(11)
    noticed = 0
    for bit in rng.integers(0, 8 * len(data), 400).tolist():
        damaged = bytearray(data)
        damaged[bit // 8] ^= 1 << (bit % 8)
        flipped.write_bytes(damaged)
        try:
            recording = Recording(flipped)
        except RecordingError:
            noticed += 1
            continue
        numbers = recording.row_numbers()
        assert same_bits(recording.array(recording.names), rows[numbers]), bit
        assert all((e.number, e.content) in truth for e in recording.events)
        assert all(recording.metadata[name] == whole.metadata[name] for name in recording.metadata)
        complete = (len(numbers), len(recording.events), len(recording.metadata)) == (300, 1, len(whole.metadata))
        assert complete or recording.health.lost, bit
        noticed += recording.health.lost
    assert noticed > 200  # the rest hit headers and indexes that say nothing that is not said elsewhere


def test_a_damaged_block_costs_only_itself(write_file: WriteFile) -> None:
    path, rows = write_file(1000)
    data = bytearray(path.read_bytes())
    data[chunk_ends(path)[4] - 50] ^= 0x10
    path.write_bytes(data)
    recording = Recording(path)
    assert recording.health.row_gaps == (RowGap(400, 100),)
    assert recording.health.missing_events == 1  # it shared the chunk
    assert same_bits(recording.array(recording.names), np.delete(rows, slice(400, 500), axis=0))
    assert "100 ticks are missing from row 400 on" in recording.health.lines()


def test_lost_framing_is_found_again(write_file: WriteFile) -> None:
    path, rows = write_file(1000)
    data = bytearray(path.read_bytes())
    start = chunk_ends(path)[4]  # a message index record: break its length
    data[start + 3] ^= 0xFF
    path.write_bytes(data)
    recording = Recording(path)
    assert recording.n_rows == 1000
    assert same_bits(recording.array(recording.names), rows)
    (damage,) = recording.health.damage
    assert damage.offset == start
    assert "framing" in damage.reason


@pytest.mark.parametrize(
    ("content", "says"),
    [
        (b"", "is empty"),
        (b"\x00" * 100, "does not begin like an MCAP file"),
        (b"\x89MCAP0\r\n", "no column layout"),
        (b"\x89MCAP0\r\n" + b"\xff" * 500, "no column layout"),
    ],
)
def test_garbage_is_one_clear_error(tmp_path: Path, content: bytes, says: str) -> None:
    path = tmp_path / "garbage.mcap"
    path.write_bytes(content)
    with pytest.raises(RecordingError, match=says) as caught:
        Recording(path)
    assert str(path) in str(caught.value)


def test_a_file_that_is_not_there_is_one_clear_error(tmp_path: Path) -> None:
    with pytest.raises(RecordingError, match="cannot be read"):
        Recording(tmp_path / "absent.mcap")


def test_an_existing_file_is_not_overwritten_unasked(write_file: WriteFile) -> None:
    path, rows = write_file(100)
    with pytest.raises(RecordingError, match="exists already"):
        RecordingWriter(path, COLUMNS, {})
    assert same_bits(Recording(path).array([n for n, _ in COLUMNS]), rows)


def test_an_unknown_column_names_the_known_ones(write_file: WriteFile) -> None:
    path, _ = write_file(100)
    with pytest.raises(RecordingError, match=r"no column 'speed'; it has: tick, t, volts_0"):
        Recording(path).column("speed")


def test_gaps_of_the_instrument_and_of_the_recording_are_told_apart(tmp_path: Path) -> None:
    rows = make_rows(400)
    rows[150:, 0] += 5  # the device lost 5 scans inside a block
    rows[300:, 0] += 2  # and 2 at the edge of a block, where no row is missing
    path = tmp_path / "gaps.mcap"
    writer = RecordingWriter(path, COLUMNS, {})
    for row0, part in ((0, rows[:100]), (100, rows[100:200]), (230, rows[230:300]), (300, rows[300:])):
        writer.write_block(row0, part)
    writer.finish({"ended": "stopped", "rows_pushed": 410, "rows_dropped": 30})
    health = Recording(path).health
    assert health.row_gaps == (RowGap(200, 30), RowGap(400, 10))
    assert (health.missing_rows, health.dropped) == (40, 30)
    assert health.tick_gaps == (TickGap(149, 155), TickGap(304, 307))
    assert health.missing_ticks == 7
    assert health.lost


def test_column_names_are_unique(tmp_path: Path) -> None:
    with pytest.raises(RecordingError, match="two columns are called 'a'"):
        RecordingWriter(tmp_path / "x.mcap", [("a", "1"), ("a", "V")], {})
    assert not (tmp_path / "x.mcap").exists()
