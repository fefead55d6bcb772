"""MCAP files as parts: taken apart, changed inside, and put together with right lengths and CRCs.

A fuzzer that changes bytes of a recording is stopped by the first CRC. This one changes what stands behind the CRCs:
the records of a chunk, the header of a block, the text of a metadata record, and the sizes that are claimed.
"""

from __future__ import annotations

import json
import random
import struct
import zlib
from collections.abc import Callable
from dataclasses import dataclass, field, replace

import lz4.frame
import zstandard
from mcap.writer import MCAP0_MAGIC

HEADER, FOOTER, SCHEMA, CHANNEL, MESSAGE, CHUNK, METADATA = 1, 2, 3, 4, 5, 6, 12
INTERESTING = (0, 1, 2, 99, 100, 101, 255, 65_535, 1 << 26, (1 << 31) - 1, (1 << 32) - 1, 1 << 53, (1 << 63) - 1)
HOSTILE_JSON: tuple[str, ...] = (
    "", "null", "[]", "{}", "0", "-1", "1e999", "NaN", '"text"', "[" * 3000, '{"a":' * 300, '"\\ud800"', "[[]]",
    '{"rows_pushed": "many"}', '{"rows_pushed": -5, "metadata": 3}', '{"rows_pushed": 1e300}', '{"ended": []}',
    '{"metadata": [1, {}]}', '{"rows_dropped": 99999999999999999999999}', '[{"name": "t"}]', '[{"name": 1, "unit": 2}]',
    '[{"name": "t", "unit": "s"}, {"name": "t", "unit": "s"}]', '{"x-layout": {}}', '{"x-layout": [1]}',
    '{"x-layout": [{"name": "t", "unit": "s"}]}', "9" * 5000, '{"event": "mark", "t_ns": null}', '{"\\ud800": 1}',
)  # fmt: skip
Change = Callable[[bytes, random.Random], bytes]


@dataclass(frozen=True)
class Record:
    """One record: a chunk holds others in ``inner``, all others have a ``body``."""

    opcode: int
    body: bytes = b""
    inner: tuple[Record, ...] = ()
    compression: str = "zstd"
    claims: dict[str, int] = field(default_factory=dict)  # size, crc, packed or length that differ from the truth


def take_apart(data: bytes) -> list[Record] | None:
    """The records of a sound file, chunks unpacked; None when it is not one."""
    try:
        return _records(data[len(MCAP0_MAGIC) :], top=True) if data.startswith(MCAP0_MAGIC) else None
    except (struct.error, ValueError, zstandard.ZstdError, RuntimeError):
        return None


def _records(data: bytes, top: bool) -> list[Record]:
    found: list[Record] = []
    at = 0
    while at < len(data) and not (top and data[at:] == MCAP0_MAGIC):
        opcode, length = struct.unpack_from("<BQ", data, at)
        body = data[at + 9 : at + 9 + length]
        if len(body) != length or len(found) > 10_000:
            raise ValueError("torn")
        if top and opcode == CHUNK:
            size, _crc, name_length = struct.unpack_from("<QII", body, 16)
            name = body[32 : 32 + name_length].decode()
            packed = body[40 + name_length :]
            if size > 1 << 20 or name not in ("", "zstd"):
                raise ValueError("not taken apart")
            content = packed if name == "" else zstandard.ZstdDecompressor().decompress(packed, max_output_size=1 << 20)
            found.append(Record(CHUNK, inner=tuple(_records(content, top=False)), compression=name))
        else:
            found.append(Record(opcode, body))
        at += 9 + length
    return found


def put_together(records: list[Record]) -> bytes:
    """The file, with right lengths and CRCs unless a record claims others."""
    return MCAP0_MAGIC + b"".join(encode(record) for record in records) + MCAP0_MAGIC


def encode(record: Record) -> bytes:
    body, claims = record.body, record.claims
    if record.opcode == CHUNK:
        content = b"".join(encode(inner) for inner in record.inner)
        packed = pack(record.compression, content)
        name = record.compression.encode()
        size, crc = claims.get("size", len(content)), claims.get("crc", zlib.crc32(content))
        body = struct.pack("<QQQII", 0, 0, size, crc, len(name)) + name
        body += struct.pack("<Q", claims.get("packed", len(packed))) + packed
    return struct.pack("<BQ", record.opcode, claims.get("length", len(body))) + body


def pack(compression: str, content: bytes) -> bytes:
    if compression == "zstd":
        return zstandard.compress(content)
    return lz4.frame.compress(content) if compression == "lz4" else content


def text(value: str) -> bytes:
    raw = value.encode(errors="surrogatepass")
    return struct.pack("<I", len(raw)) + raw


def metadata(name: str, kind: str, value: str, crc: str | None = None) -> Record:
    """A metadata record of ours with a right CRC, whatever it says."""
    right = f"{zlib.crc32(chr(10).join((name, kind, value)).encode(errors='surrogatepass')):08x}"
    pairs = b"".join(text(k) + text(v) for k, v in (("text", value), ("type", kind), ("crc32", crc or right)))
    return Record(METADATA, text(name) + struct.pack("<I", len(pairs)) + pairs)


def message(channel: int, sequence: int, data: bytes, time_ns: int = 0) -> Record:
    return Record(MESSAGE, struct.pack("<HIQQ", channel, sequence, time_ns, time_ns) + data)


def channel(number: int, topic: str, encoding: str = "json") -> Record:
    return Record(CHANNEL, struct.pack("<HH", number, 1) + text(topic) + text(encoding) + struct.pack("<I", 0))


def schema(name: str, data: bytes) -> Record:
    return Record(SCHEMA, struct.pack("<H", 1) + text(name) + text("jsonschema") + struct.pack("<I", len(data)) + data)


def change(data: bytes, rng: random.Random, change_bytes: Change) -> bytes:
    """``data`` with one to four changes behind its CRCs; ``change_bytes`` changes the content of a record."""
    records = take_apart(data)
    if not records:
        return change_bytes(data, rng)
    for _ in range(rng.randint(1, 4)):
        records = _change_once(records, rng, change_bytes)
    return put_together(records)


def _change_once(records: list[Record], rng: random.Random, change_bytes: Change) -> list[Record]:
    if not records:
        return [metadata("end", "json", rng.choice(HOSTILE_JSON))]
    at = rng.randrange(len(records))
    record = records[at]
    match rng.randrange(9):
        case 0:
            return records[:at] + records[at + 1 :]
        case 1:
            return [*records[:at], *[record] * rng.choice((2, 3, 50)), *records[at + 1 :]]
        case 2:
            other = rng.randrange(len(records))
            records[at], records[other] = records[other], records[at]
            return records
        case 3:
            name = rng.choice(("end", "layout", "bench", "stages", "statistics"))
            new = metadata(name, rng.choice(("json", "text", "x")), rng.choice(HOSTILE_JSON))
            return [*records[:at], new, *records[at:]]
        case 4:
            claim = {rng.choice(("size", "crc", "packed", "length")): rng.choice(INTERESTING)}
            claim = {k: v & 0xFFFFFFFF if k == "crc" else v for k, v in claim.items()}
            return [*records[:at], replace(record, claims={**record.claims, **claim}), *records[at + 1 :]]
        case _:
            chunks = [k for k, r in enumerate(records) if r.opcode == CHUNK]
            if not chunks:
                return [*records[:at], _changed_body(record, rng, change_bytes), *records[at + 1 :]]
            k = rng.choice(chunks)
            return [*records[:k], _changed_chunk(records[k], rng, change_bytes), *records[k + 1 :]]


def _changed_chunk(chunk: Record, rng: random.Random, change_bytes: Change) -> Record:
    inner = list(chunk.inner)
    if rng.randrange(6) == 0:
        return replace(chunk, compression=rng.choice(("", "lz4", "zstd", "brotli")))
    if not inner or rng.randrange(5) == 0:
        json_text = rng.choice(HOSTILE_JSON).encode(errors="surrogatepass")
        inner.append(
            rng.choice(
                (
                    message(rng.choice((1, 2, 3)), rng.choice(INTERESTING) & 0xFFFFFFFF, json_text),
                    channel(rng.choice((1, 2, 3)), rng.choice(("ticks", "events", ""))),
                    schema("micron.ticks", json_text),
                    Record(rng.choice((0, 1, 6, 200)), json_text),
                )
            )
        )
        return replace(chunk, inner=tuple(inner))
    at = rng.randrange(len(inner))
    match rng.randrange(4):
        case 0:
            inner[at : at + 1] = [inner[at]] * rng.choice((0, 2, 3))
        case 1:
            rng.shuffle(inner)
        case _:
            inner[at] = _changed_body(inner[at], rng, change_bytes)
    return replace(chunk, inner=tuple(inner))


def _changed_body(record: Record, rng: random.Random, change_bytes: Change) -> Record:
    body = bytearray(record.body)
    fields = (22 + 4, 22 + 8, 22 + 12, 22 + 16, 22 + 20) if record.opcode == MESSAGE else (0, 2, 4, 8)
    at = rng.choice(fields)
    match rng.randrange(3):
        case 0 if len(body) >= at + 4:  # channel, columns, rows, CRC of the layout, first row
            struct.pack_into("<I", body, at, rng.choice(INTERESTING) & 0xFFFFFFFF)
        case 1 if len(body) > 60:  # values of a block: NaN, infinities, huge ticks
            start = 22 + 24 + 8 * rng.randrange(max(1, (len(body) - 46) // 8))
            body[start : start + 8] = struct.pack("<d", rng.choice((float("nan"), float("inf"), -1.0, 1e300, 2.0**60)))
        case _:
            return replace(record, body=change_bytes(bytes(body), rng))
    return replace(record, body=bytes(body))


def change_some_bytes(data: bytes, rng: random.Random) -> bytes:
    """A few bytes replaced, put in or taken out; a JSON text may be replaced as a whole."""
    if data[:1] in (b"{", b"[") and rng.randrange(2):
        return rng.choice(HOSTILE_JSON).encode(errors="surrogatepass")
    changed = bytearray(data)
    for _ in range(rng.randint(1, 3)):
        at = rng.randint(0, len(changed))
        match rng.randrange(3):
            case 0 if at < len(changed):
                changed[at] = rng.randrange(256)
            case 1:
                changed[at:at] = rng.randbytes(rng.randint(1, 8))
            case _:
                del changed[at : at + rng.randint(1, 30)]
    return bytes(changed)


def layout_text(columns: list[tuple[str, str]]) -> str:
    return json.dumps([{"name": n, "unit": u} for n, u in columns], separators=(",", ":"))
