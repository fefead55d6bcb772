"""Recordings made to hurt: sizes that lie, frames that unpack to gigabytes, false chunks, nonsense behind right CRCs.

Work is counted in bytes, never in seconds.
"""

from __future__ import annotations

import asyncio
import io
import json
import struct
import tracemalloc
import zlib
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path

import lz4.frame
import numpy as np
import pytest
import zstandard
from mcap.writer import MCAP0_MAGIC
from starlette.requests import Request
from starlette.responses import Response
from starlette.routing import Route

from firmware_py.control.replay import recorded_configs
from firmware_py.recording import format as fmt
from firmware_py.recording import reader as reader_module
from firmware_py.recording import scan as scan_module
from firmware_py.recording.errors import RecordingError
from firmware_py.recording.reader import Recording
from firmware_py.recording.scan import Scanner
from firmware_py.recording.unpack import FileTooExpansive, UnpackBudget, unpack
from firmware_py.recording.writer import RecordingWriter
from hal.errors import HalError
from tests.fuzz.mcap_parts import (
    CHUNK,
    HOSTILE_JSON,
    Record,
    channel,
    encode,
    message,
    metadata,
    put_together,
    schema,
)
from tests.unit.recording.samples import same_bits
from tools.bench.collect import collect_routes, listing, quick_look
from tools.errors import InputError
from tools.errors import RecordingError as TwinRecordingError
from tools.mismatch.recording_columns import column_names, read_columns

COLUMNS = [("tick", "1"), ("t", "s")]
LAYOUT = fmt.layout_text(fmt.check_columns(COLUMNS))
CRC = zlib.crc32(LAYOUT.encode())
HEAD = [Record(1, struct.pack("<II", 0, 0)), metadata("layout", "text", LAYOUT)]
CHANNELS = (channel(1, "ticks", "x-micron-ticks"), channel(2, "events"))


def block(row0: int, n: int = 4) -> bytes:
    rows = np.column_stack([np.arange(row0, row0 + n), np.arange(row0, row0 + n) * 1e-3])
    return fmt.encode_block(row0, rows, CRC)


def chunk(*inner: Record, compression: str = "zstd", **claims: int) -> Record:
    return Record(CHUNK, inner=(*CHANNELS, *inner), compression=compression, claims=claims)


@pytest.fixture
def write(tmp_path: Path) -> Callable[..., Path]:
    def _write(*records: Record, name: str = "r.mcap") -> Path:
        path = tmp_path / name
        path.write_bytes(put_together([*HEAD, *records, Record(15, b"\0\0\0\0"), Record(2, bytes(20))]))
        return path

    return _write


def bomb(compression: str, claimed: int, mib: int = 256) -> bytes:
    """A chunk record of some kilobytes whose frame delivers ``mib`` MiB and whose header claims ``claimed`` bytes."""
    part = bytes(1 << 20)
    if compression == "zstd":
        packer = zstandard.ZstdCompressor(level=1).compressobj(size=mib << 20)
        packed = b"".join(packer.compress(part) for _ in range(mib)) + packer.flush()
    else:
        lz4_packer = lz4.frame.LZ4FrameCompressor()
        packed = lz4_packer.begin(mib << 20) + b"".join(lz4_packer.compress(part) for _ in range(mib))
        packed += lz4_packer.flush()
    name = compression.encode()
    body = struct.pack("<QQQII", 0, 0, claimed, 1, len(name)) + name + struct.pack("<Q", len(packed)) + packed
    return struct.pack("<BQ", CHUNK, len(body)) + body


def peak_bytes(work: Callable[[], object]) -> int:
    tracemalloc.start()
    try:
        work()
        return tracemalloc.get_traced_memory()[1]
    finally:
        tracemalloc.stop()


class TestBombs:
    @pytest.mark.parametrize("compression", ["zstd", "lz4"])
    @pytest.mark.parametrize(
        ("claimed", "says"),
        [(1000, "claims 1000 bytes and holds more"), (256 << 20, "at most 67108864"), (1 << 63, "at most 67108864")],
    )
    def test_a_frame_that_delivers_256_MiB_is_stopped_at_what_its_header_claims(
        self, tmp_path: Path, compression: str, claimed: int, says: str
    ) -> None:
        path = tmp_path / "bomb.mcap"
        sound = encode(chunk(message(1, 0, block(0))))
        path.write_bytes(MCAP0_MAGIC + b"".join(encode(r) for r in HEAD) + bomb(compression, claimed) + sound)
        found: list[Recording] = []
        assert peak_bytes(lambda: found.append(Recording(path))) < 8 << 20
        (recording,) = found
        assert recording.n_rows == 4  # a damaged chunk costs only itself
        assert any(says in d.reason for d in recording.health.damage), recording.health.damage
        assert peak_bytes(lambda: quick_look(path, ["tick"])) < 8 << 20

    @pytest.mark.parametrize("compression", ["zstd", "lz4"])
    def test_a_recording_for_the_mismatch_engine_is_bounded_alike(self, tmp_path: Path, compression: str) -> None:
        path = tmp_path / "bomb.mcap"
        path.write_bytes(MCAP0_MAGIC + bomb(compression, 256 << 20) + MCAP0_MAGIC)
        for read in (lambda: column_names(path), lambda: read_columns(path, ["log.x"])):

            def refused(read: Callable[[], object] = read) -> None:
                with pytest.raises(TwinRecordingError, match="claims 268435456 bytes; at most 67108864 are read"):
                    read()

            assert peak_bytes(refused) < 8 << 20

    def test_many_small_frames_are_stopped_together(self) -> None:
        """A file of 64 kB may unpack to 288 MiB in all, and the budget is asked before the work is done."""
        part = encode(Record(CHUNK, inner=(Record(15, bytes((1 << 26) - 9)),)))
        assert len(part) < 4096
        file = io.BytesIO(MCAP0_MAGIC + part * 16)
        scanner = Scanner(file, Path("many.mcap"))
        with pytest.raises(RecordingError, match=r"many\.mcap is not read: it unpacks to more than \d+ MiB"):
            for _ in scanner.items():
                pass
        assert scanner.budget.limit < 320 << 20

    def test_records_cost_more_than_their_bytes(self) -> None:
        """64 MiB of empty records would be seven million turns of a loop."""
        budget = UnpackBudget(10_000)
        content = struct.pack("<BQ", 200, 0) * 50_000
        before = budget.left
        assert list(reader_module.chunk_records(content, budget)) == []
        assert before - budget.left == 50_000 * 256
        budget.left = 1000
        with pytest.raises(FileTooExpansive):
            list(reader_module.chunk_records(content, budget))

    def test_a_window_larger_than_a_chunk_is_not_allocated(self) -> None:
        parameters = zstandard.ZstdCompressionParameters.from_level(1, window_log=27)
        frame = zstandard.ZstdCompressor(compression_params=parameters).compressobj()
        packed = frame.compress(b"x" * 100) + frame.flush()
        with pytest.raises(RecordingError, match="cannot be unpacked"):
            unpack("zstd", packed, 100)

    @pytest.mark.parametrize("compression", ["", "zstd", "lz4"])
    def test_sound_frames_of_all_sizes_come_out(self, compression: str) -> None:
        rng = np.random.default_rng(1)
        for n in (0, 1, 100, 65_536, 1 << 20, (1 << 20) + 1, 5_000_000):
            content = rng.integers(0, 4, n, dtype=np.uint8).tobytes()
            packed = {"": bytes, "zstd": zstandard.compress, "lz4": lz4.frame.compress}[compression](content)
            assert unpack(compression, packed, n) == content
            if n:
                with pytest.raises(RecordingError, match="claims"):
                    unpack(compression, packed, n - 1)
            with pytest.raises(RecordingError, match="claims"):
                unpack(compression, packed, n + 1)


class CountingFile(io.BytesIO):
    bytes_read = 0

    def read(self, size: int | None = -1, /) -> bytes:
        data = super().read(size)
        self.bytes_read += len(data)
        return data


def false_headers(n_bytes: int) -> bytes:
    """Headers of chunks, one after the other, each of which claims the rest of the file, with lengths that agree."""
    out = bytearray(MCAP0_MAGIC + b"\xff")
    while (left := n_bytes - len(out) - 9) > 60:
        out += struct.pack("<BQQQQII", CHUNK, left, 0, 0, 1000, 1, 4) + b"zstd" + struct.pack("<Q", left - 44)
    return bytes(out).ljust(n_bytes, b"\0")


def chunks_between_garbage(n_bytes: int) -> bytes:
    """Sound chunks of some bytes, one byte of garbage after each: the framing is lost and found all the time."""
    content = struct.pack("<BQ", 200, 1) + b"x"
    body = struct.pack("<QQQIIQ", 0, 0, len(content), zlib.crc32(content), 0, len(content)) + content
    unit = struct.pack("<BQ", CHUNK, len(body)) + body + b"\xff"
    return MCAP0_MAGIC + unit * (n_bytes // len(unit))


def names_only(n_bytes: int) -> bytes:
    return MCAP0_MAGIC + b"\xff" + (b"\x06" + bytes(36) + b"\x04\0\0\0zstd") * (n_bytes // 45)


@pytest.mark.parametrize("make", [false_headers, chunks_between_garbage, names_only])
def test_the_search_for_lost_framing_is_linear(make: Callable[[int], bytes], monkeypatch: pytest.MonkeyPatch) -> None:
    """4 MB of false headers took 50 s: each of them was read to the end of the file. Here without the 16 MiB that
    every file is granted, so that small files show the slope."""
    monkeypatch.setattr(scan_module, "MOST_SEARCH_BYTES", 0)
    costs = []
    for n_bytes in (1 << 17, 1 << 18, 1 << 19):
        file = CountingFile(make(n_bytes))
        scanner = Scanner(file, Path("x"))
        items = sum(1 for _ in scanner.items())
        costs.append((file.bytes_read + scanner.budget.limit - scanner.budget.left + 100 * items) / n_bytes)
    assert max(costs) < 1.1 * min(costs)
    assert max(costs) < 40.0


def test_behind_false_headers_a_sound_chunk_is_still_found() -> None:
    """The limit of the search is above what an accident can make: 50 false headers before each sound chunk."""
    sound = encode(chunk(message(1, 0, block(0)))) + b"\xff"
    false = false_headers(3000)[len(MCAP0_MAGIC) :]
    items = list(Scanner(io.BytesIO(MCAP0_MAGIC + (false + sound) * 20), Path("x")).items())
    assert sum(type(item).__name__ == "ChunkRecord" for item in items) == 20


@pytest.mark.parametrize("compression", ["", "lz4", "zstd"])
def test_lost_framing_is_found_again_whatever_the_compression(write: Callable[..., Path], compression: str) -> None:
    path = write(*(chunk(message(1, k, block(4 * k)), compression=compression) for k in range(3)))
    data = bytearray(path.read_bytes())
    second = data.index(encode(chunk(message(1, 1, block(4)), compression=compression)))
    data[second + 5] ^= 0xFF  # the length of the second chunk's record
    path.write_bytes(data)
    recording = Recording(path)
    assert recording.row_numbers().tolist() == [0, 1, 2, 3, 8, 9, 10, 11]
    assert recording.health.row_gaps[0] == (4, 4)


class TestNonsenseBehindRightCrcs:
    """Each of these was a traceback, or a wrong figure."""

    @pytest.mark.parametrize("text", HOSTILE_JSON)
    @pytest.mark.parametrize("name", ["end", "layout", "bench", "stages", "statistics"])
    @pytest.mark.parametrize("kind", ["json", "text"])
    def test_metadata(self, write: Callable[..., Path], name: str, kind: str, text: str) -> None:
        path = write(metadata(name, kind, text), chunk(message(1, 0, block(0))))
        try:
            recording = Recording(path)
        except RecordingError:
            return
        assert recording.n_rows == 4
        "\n".join(recording.health.lines()).encode()
        with suppress(HalError):
            recorded_configs(recording)

    @pytest.mark.parametrize("text", HOSTILE_JSON)
    def test_events_and_schemas(self, write: Callable[..., Path], text: str) -> None:
        raw = text.encode(errors="surrogatepass")
        recording = Recording(write(chunk(message(2, 0, raw), message(1, 0, block(0)))))
        assert recording.n_rows == 4
        assert all(isinstance(event.content, dict) for event in recording.events)
        assert len(recording.events) == 1 or any("event 0 is not read" in d.reason for d in recording.health.damage)
        path = write(chunk(message(1, 0, block(0))))
        without_layout = put_together([HEAD[0], chunk(schema("micron.ticks", raw), message(1, 0, block(0)))])
        path.write_bytes(without_layout)
        with pytest.raises(RecordingError):
            Recording(path)

    @pytest.mark.parametrize(
        ("columns", "rows", "row0", "says"),
        [
            (4, 2, 0, "a block claims 2 rows from row 0 on, of 4 columns"),  # the same number of values
            (2, 4, 1 << 63, "from row 9223372036854775808 on"),
            (2, 4, (1 << 53) - 3, "from row 9007199254740989 on"),
            (0, 0, 0, "not a block of ticks"),
            (1 << 31, 1 << 31, 0, "not a block of ticks"),
        ],
    )
    def test_headers_of_blocks(self, write: Callable[..., Path], columns: int, rows: int, row0: int, says: str) -> None:
        body = struct.pack("<4sIIIQ", b"MTB1", columns, rows, CRC, row0) + block(0)[24:]
        with pytest.raises(RecordingError, match=says):
            Recording(write(chunk(message(1, 0, body))))

    def test_a_block_without_rows(self, write: Callable[..., Path]) -> None:
        with pytest.raises(RecordingError, match="a block claims 0 rows"):
            Recording(write(chunk(message(1, 0, struct.pack("<4sIIIQ", b"MTB1", 2, 0, CRC, 0)))))

    @pytest.mark.parametrize("row0", [0, 2, 3])
    def test_overlapping_blocks_never_give_a_negative_count(self, write: Callable[..., Path], row0: int) -> None:
        path = write(chunk(message(1, 0, block(0)), message(1, 1, block(row0, 3))))
        with pytest.raises(RecordingError, match=f"two different versions of row {row0}"):
            Recording(path)

    @pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf, -5.0, 1e300, 2.0**63])
    def test_ticks_that_are_no_ticks(self, write: Callable[..., Path], value: float) -> None:
        rows = np.array([[value, value], [1.0, 1e-3]])
        recording = Recording(write(chunk(message(1, 0, fmt.encode_block(0, rows, CRC)))))
        assert same_bits(recording.array(["tick", "t"]), rows)
        assert recording.health.missing_ticks == 0

    def test_a_layout_of_20_000_columns_is_refused_at_once(self, write: Callable[..., Path]) -> None:
        text = json.dumps([{"name": str(k), "unit": ""} for k in range(20_000)])
        path = write()
        path.write_bytes(put_together([HEAD[0], metadata("layout", "text", text)]))
        with pytest.raises(RecordingError, match="no column layout"):
            Recording(path)
        with pytest.raises(RecordingError, match="1 to 10000 columns, not 20000"):
            fmt.layout_of_text(text)

    def test_damage_is_listed_up_to_a_limit_and_counted_beyond_it(self, write: Callable[..., Path]) -> None:
        health = Recording(write(*(metadata("bench", "json", f"[{k}") for k in range(1500)))).health
        assert len(health.damage) == 1001
        assert health.damage[-1].reason == "500 more places are damaged"

    def test_events_have_an_end(self, write: Callable[..., Path], monkeypatch: pytest.MonkeyPatch) -> None:
        monkeypatch.setattr(reader_module, "MOST_EVENTS_BYTES", 1000)
        events = [message(2, k, b'{"event": "mark"}') for k in range(20)]
        recording = Recording(write(chunk(*events, message(1, 0, block(0)))))
        assert len(recording.events) == 1000 // (128 + 17)
        assert recording.health.missing_events == 0 or recording.health.lost
        assert recording.n_rows == 4

    def test_rows_scattered_over_chunks_are_not_unpacked_again_and_again(
        self, write: Callable[..., Path], monkeypatch: pytest.MonkeyPatch
    ) -> None:
        """Even rows in one chunk, odd ones in another: each block would unpack a chunk of up to 64 MiB."""
        halves = [chunk(*(message(1, k, block(k, 1)) for k in range(first, 400, 2))) for first in (0, 1)]
        recording = Recording(write(*halves))
        assert recording.array(["tick"])[:, 0].tolist() == list(range(400))
        monkeypatch.setattr(reader_module, "_FREE_REREAD_BYTES", 0)
        with pytest.raises(RecordingError, match=r"scattered over its chunks; put them in order first \('mcap sort"):
            recording.array(["tick"])

    def test_a_file_that_changes_while_it_is_read(self, write: Callable[..., Path]) -> None:
        path = write(chunk(message(1, 0, block(0))))
        recording = Recording(path)
        path.write_bytes(path.read_bytes()[:200])
        with pytest.raises(RecordingError, match=r"r\.mcap"):
            recording.array(["tick"])
        path.unlink()
        with pytest.raises(RecordingError, match="cannot be read"):
            recording.array(["tick"])

    def test_what_follows_the_end_is_damage(self, write: Callable[..., Path]) -> None:
        path = write(chunk(message(1, 0, block(0))))
        path.write_bytes(path.read_bytes() + path.read_bytes())
        assert any("follows the end" in d.reason for d in Recording(path).health.damage)


class TestQuickLook:
    """``GET /api/recordings/NAME/look`` reads strangers' files without a token."""

    def test_its_figures_are_those_of_the_whole_recording(self, tmp_path: Path) -> None:
        n = 5003
        rng = np.random.default_rng(2)
        rows = np.column_stack([np.arange(n), np.arange(n) * 1e-3, rng.normal(size=n)])
        path = tmp_path / "r.mcap"
        writer = RecordingWriter(path, [*COLUMNS, ("x", "V")], {})
        for start in range(0, n, 37):
            writer.write_block(start, rows[start : start + 37])
        writer.finish({"ended": "stopped", "rows_pushed": n})
        look = quick_look(path, ["x", "x", "nowhere"])
        k = n // 900
        assert look["channels"] == ["x"]
        assert look["t"] == rows[::k, 1].tolist()
        values = rows[:, 2].astype(np.float32)
        assert look["low"][0] == [float(values[i : i + k].min()) for i in range(0, n, k)]
        assert look["high"][0] == [float(values[i : i + k].max()) for i in range(0, n, k)]

    @pytest.mark.parametrize("columns", [[("tick", "1")], [("x", "1"), ("y", "s")]])
    def test_a_recording_without_time_is_one_clear_error(self, tmp_path: Path, columns: list[tuple[str, str]]) -> None:
        path = tmp_path / "r.mcap"
        writer = RecordingWriter(path, columns, {})
        writer.write_block(0, np.zeros((3, len(columns))))
        writer.finish({})
        with pytest.raises(InputError, match=r"r\.mcap holds no ticks with a time"):
            quick_look(path, ["tick"])

    @pytest.mark.parametrize(
        "notes", [b"[1]", b"[" * 5000, b'{"notes": 3}', b'{"ticks": NaN}', b"\xff", b'"x"', b" " * (1 << 21)]
    )
    def test_notes_of_strangers_do_not_cost_the_list(self, tmp_path: Path, notes: bytes) -> None:
        (tmp_path / "r.mcap").write_bytes(b"")
        (tmp_path / "r.json").write_bytes(notes)
        (row,) = listing(tmp_path, "")
        assert row["notes"] == ["(its notes cannot be read)"]
        json.dumps(row, allow_nan=False)

    def test_over_http_hostile_files_are_one_line(self, tmp_path: Path) -> None:
        class Recorder:
            folder = tmp_path
            active = False
            name = ""

            def path(self, name: str) -> Path:
                return tmp_path / f"{name}.mcap"

        class Session:
            recorder = Recorder()

        rows = np.array([[0.0, np.nan], [1.0, np.inf]])
        files = {
            "bomb": MCAP0_MAGIC + b"".join(encode(r) for r in HEAD) + bomb("zstd", 256 << 20),
            "no layout": MCAP0_MAGIC + b"\xff" * 100,
            "nan": put_together([*HEAD, chunk(message(1, 0, fmt.encode_block(0, rows, CRC)))]),
            "overlap": put_together([*HEAD, chunk(message(1, 0, block(0)), message(1, 0, block(1)))]),
        }
        for name, data in files.items():
            (tmp_path / f"{name}.mcap").write_bytes(data)
        (look,) = [
            route.endpoint
            for route in collect_routes(Session(), None)  # type: ignore[arg-type]
            if isinstance(route, Route) and route.path.endswith("/look")
        ]

        async def ask() -> dict[str, Response]:
            return {
                name: await look(
                    Request({"type": "http", "path_params": {"name": name}, "query_string": b"channels=tick"})
                )
                for name in files
            }

        answers = asyncio.run(ask())
        assert {name: answer.status_code for name, answer in answers.items()} == {
            "bomb": 400, "no layout": 400, "nan": 200, "overlap": 400,
        }  # fmt: skip
        assert json.loads(answers["bomb"].body) == {"error": "bomb.mcap holds no ticks with a time"}
        assert "two different versions of row 1" in json.loads(answers["overlap"].body)["error"]
