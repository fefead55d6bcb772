"""Every parser of bytes that somebody else wrote, as a function of bytes that must end in a value or a clear error.

Anything else that comes out is a crash: used by hypothesis (test_parsers.py) and, coverage guided, by run.py.
"""

from __future__ import annotations

import io
import json
import math
import socket
import tempfile
import zipfile
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path

import numpy as np

from drivers.can_telemetry import CanTelemetry
from drivers.daq.di4108 import Di4108
from drivers.motion_card_protocol import LineParser
from drivers.piezo.can_amplifier import CanAmplifier
from drivers.piezo.gcs import GcsLink
from drivers.specs import check_devices
from firmware_py.control.replay import recorded_configs
from firmware_py.live.link import LiveLink
from firmware_py.recording.errors import RecordingError
from firmware_py.recording.reader import Recording
from firmware_py.recording.recover import recover
from firmware_py.recording.writer import RecordingWriter
from hal.bench import load_bench
from hal.clock import VirtualClock
from hal.errors import HalError
from hal.jsonable import to_jsonable
from hal.types import CanFrame, CanStats, PortInfo, ScanConfig
from sim_devices.plant.hand_file import HandFileError, load_hand
from tests.conftest import DEFAULT_BENCH
from tests.recording_text import channel
from tools.bench.collect import quick_look
from tools.bench.viewer import Nonsense
from tools.bench.viewer import _parse as parse_message
from tools.cli.mismatch_plan import read_report
from tools.errors import InputError
from tools.errors import RecordingError as TwinRecordingError
from tools.mismatch.recording_columns import column_names, read_columns
from tools.mismatch.recording_load import load
from tools.mismatch.twins.fmu import check_archive

MS = 1_000_000


class BytesPort:
    """SerialPort that delivers ``data`` in small reads, then silence; echoes nothing."""

    def __init__(self, data: bytes, clock: VirtualClock) -> None:
        self._data, self._clock = io.BytesIO(data), clock

    def read_into(self, buf: memoryview, timeout_s: float) -> int:
        piece = self._data.read(min(len(buf), 37))
        self._clock.burn_ns(round(timeout_s * 1e9) if not piece else 1000)
        buf[: len(piece)] = piece
        return len(piece)

    def write(self, data: bytes, timeout_s: float) -> None:
        return

    def drain_input(self) -> int:
        return 0

    def info(self) -> PortInfo:
        return PortInfo("bytes", "fuzz", emulated=True, details={})

    def close(self) -> None:
        return


class FramesBus:
    """CanBus that hears ``data`` as frames: two bytes of identifier, one of length, the rest."""

    def __init__(self, data: bytes) -> None:
        self._frames: list[CanFrame] = []
        while len(data) >= 3:
            can_id, n = int.from_bytes(data[:2], "little") & 0x7FF, data[2] % 9
            self._frames.append(CanFrame(can_id, data[3 : 3 + n]))
            data = data[3 + n :]

    def recv(self, timeout_s: float) -> CanFrame | None:
        return self._frames.pop(0) if self._frames else None

    def send(self, frame: CanFrame, timeout_s: float) -> None:
        return

    def stats(self) -> CanStats:
        return CanStats()

    def info(self) -> PortInfo:
        return PortInfo("frames", "fuzz", emulated=True, details={})

    def close(self) -> None:
        return


def _file(data: bytes, suffix: str, read: Callable[[Path], object], *clear: type[Exception]) -> None:
    with tempfile.TemporaryDirectory(prefix="micron-fuzz-") as folder:
        path = Path(folder) / f"input{suffix}"
        path.write_bytes(data)
        with suppress(*clear):
            read(path)


def bench_toml(data: bytes) -> None:
    _file(data, ".toml", lambda p: check_devices(load_bench(p).description, "x"), HalError)


def own_recording(data: bytes) -> None:
    def read(path: Path) -> None:
        recording = Recording(path)
        rows = sum(block.data.shape[1] for block in recording.blocks())
        numbers = recording.row_numbers()
        health = recording.health
        assert rows == recording.n_rows == health.rows == len(numbers)
        assert (np.diff(numbers) > 0).all()
        assert health.missing_rows >= 0
        assert health.missing_events >= 0
        assert health.missing_ticks >= 0
        json.dumps(to_jsonable(health.as_dict())).encode()
        "\n".join(health.lines()).encode()
        report = recover(path, path.with_name("out.mcap"))
        again = Recording(report.out)
        assert np.array_equal(again.row_numbers(), numbers)
        assert again.array(recording.names).tobytes() == recording.array(recording.names).tobytes()
        assert [e.content for e in again.events] == [e.content for e in recording.events]
        with suppress(RecordingError, InputError):
            json.dumps(quick_look(path, ["t", "tick", "nowhere"]), allow_nan=False)
        with suppress(HalError):
            recorded_configs(recording)

    _file(data, ".mcap", read, RecordingError)


def columns_csv(data: bytes) -> None:
    _file(data, ".csv", lambda p: read_columns(p, ["t", "x"]), TwinRecordingError)
    _file(data, ".csv", column_names, TwinRecordingError)


def columns_npz(data: bytes) -> None:
    _file(data, ".npz", lambda p: read_columns(p, ["t", "x"]), TwinRecordingError)


def columns_mcap(data: bytes) -> None:
    _file(data, ".mcap", lambda p: read_columns(p, ["log.x", "log.y"]), TwinRecordingError)
    _file(data, ".mcap", column_names, TwinRecordingError)


def descriptor_toml(data: bytes) -> None:
    def read(path: Path) -> None:
        (path.parent / "data.csv").write_text("t,x,y\n" + "".join(f"{k},{k % 7},{k % 5}\n" for k in range(80)))
        load(path)

    _file(data, ".toml", read, TwinRecordingError)


def hand_csv(data: bytes) -> None:
    _file(data, ".csv", lambda p: load_hand(str(p)), HandFileError)


def hand_npz(data: bytes) -> None:
    _file(data, ".npz", lambda p: load_hand(str(p)), HandFileError)


def fmu_archive(data: bytes) -> None:
    _file(data, ".fmu", check_archive, TwinRecordingError)


def di4108_stream(data: bytes) -> None:
    clock = VirtualClock()
    daq = Di4108(BytesPort(b"", clock), clock)
    with suppress(HalError):
        daq._command = lambda text: None  # type: ignore[method-assign]
        daq.stop = lambda: None  # type: ignore[method-assign]
        daq.configure(ScanConfig(1000.0, (0, 1, 2, 3), (5.0,) * 4))
        daq.start()
        daq._port = BytesPort(data, clock)
        out = np.zeros((64, 4), dtype=np.int16)
        for _ in range(20):
            block = daq.read_scans(out, 0.001)
            assert 0 <= block.n <= 64
            assert block.lost >= 0


def di4108_answers(data: bytes) -> None:
    clock = VirtualClock()
    with suppress(HalError):
        Di4108(BytesPort(data, clock), clock).probe()


def motion_card_lines(data: bytes) -> None:
    for fields in ("raw", "scaled"):
        parser = LineParser(fields)
        for start in range(0, len(data), 50):
            for reading in parser.feed(data[start : start + 50]):
                assert all(math.isfinite(v) for v in reading.values)
        assert len(parser._buffer) < 1000  # what is kept is bounded


def gcs_replies(data: bytes) -> None:
    clock = VirtualClock()
    with suppress(HalError):
        assert all(math.isfinite(v) for v in GcsLink(BytesPort(data, clock), clock, "e727").values("VOL?", 3))
    link = GcsLink(BytesPort(data, clock), clock, "e727")
    with suppress(HalError):
        link.ask_error()
        for _ in range(10):
            link.take_error()


def can_frames(data: bytes) -> None:
    clock = VirtualClock(MS)
    telemetry = CanTelemetry(FramesBus(data), clock)
    for _ in range(4):
        telemetry.poll()
    amplifier = CanAmplifier(FramesBus(data), clock)
    with suppress(HalError):
        for _ in range(4):
            amplifier.poll()


def page_orders(data: bytes) -> None:
    ours, theirs = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
    with ours:
        link = LiveLink.__new__(LiveLink)
        link._control, link._hung_up = theirs, False
        theirs.setblocking(False)
        ours.send(data[:1000] or b" ")
        for order in link.orders():
            assert isinstance(order["order"], str)
        theirs.close()


def websocket_messages(data: bytes) -> None:
    with suppress(Nonsense):
        assert isinstance(parse_message(data.decode("utf-8", "surrogateescape")), dict)


def json_reports(data: bytes) -> None:
    _file(data, ".json", read_report, InputError)


TARGETS: dict[str, Callable[[bytes], None]] = {
    f.__name__: f
    for f in (
        bench_toml, own_recording, columns_csv, columns_npz, columns_mcap, descriptor_toml, hand_csv, hand_npz,
        fmu_archive, di4108_stream, di4108_answers, motion_card_lines, gcs_replies, can_frames, page_orders,
        websocket_messages, json_reports,
    )
}  # fmt: skip


def seeds() -> dict[str, list[bytes]]:
    """Sound inputs to start from, by target, besides those in ``corpus/``."""
    n, long = np.arange(60), np.arange(260)
    csv = ("t,x\n" + "".join(f"{k * 0.001:.3f},{(k % 9) * 0.5}\n" for k in n)).encode()
    hand = ("t_s,x_um,y_um,z_um\n" + "".join(f"{k * 0.02:.3f},{k % 5},{k % 3},1\n" for k in long)).encode()
    npz = _saved(t=n * 1e-3, x=np.sin(n))
    card = b"#:1:2:3:-4:5:6:7:0:\r\n" * 3
    return {
        "bench_toml": [DEFAULT_BENCH.read_bytes()],
        "own_recording": [_own_recording()],
        "columns_csv": [csv, b"t;x\n1;2\n"],
        "columns_npz": [npz],
        "columns_mcap": [_json_mcap()],
        "descriptor_toml": [_DESCRIPTOR.encode()],
        "hand_csv": [hand],
        "hand_npz": [_saved(t_s=long * 0.02, x_um=np.sin(long), y_um=np.cos(long), z_um=long * 0.0)],
        "fmu_archive": [_archive("modelDescription.xml"), _archive("../../outside"), npz],
        "di4108_stream": [bytes(range(256)) * 2, b"\x01\x00" * 64 + b"stop 01"],
        "di4108_answers": [b"stop\rinfo 1 4108\rinfo 2 65\rinfo 6 00000000\r"],
        "motion_card_lines": [card, b"#:1.5:2.25:-0.5:4.0:5.0:6.0:36.5:1:\r\n"],
        "gcs_replies": [b"1=5.0e+01 \n2=5.0e+01 \n3=nan\n", b"0\n", b"1=1e999\n"],
        "can_frames": [b"\x80\x00\x01\x01" * 3, b"\x90\x01\x08abcdefgh\x91\x01\x02ab"],
        "page_orders": [b'{"order":"jog","channel":1,"rate_V_per_s":1e400}', b'{"order": 1}', b"[" * 900],
        "websocket_messages": [b'{"type":"subscribe","id":1}', b"[" * 5000, b'{"type":"range","from":NaN}'],
        "json_reports": [b'{"format": 1, "verdict": "x", "physics": []}', b"[" * 100_000, b'{"format": 1e999}'],
    }


def _saved(**arrays: np.ndarray) -> bytes:
    out = io.BytesIO()
    np.savez(out, **arrays)
    return out.getvalue()


def _archive(name: str) -> bytes:
    out = io.BytesIO()
    with zipfile.ZipFile(out, "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr(name, "x" * 1000)
    return out.getvalue()


def _own_recording() -> bytes:
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "r.mcap"
        writer = RecordingWriter(path, [("tick", "1"), ("t", "s")], {"bench": "x"})
        writer.write_event(0, {"event": "mark", "t_ns": 1})
        writer.write_block(0, np.column_stack([np.arange(20.0), np.arange(20.0) * 1e-3]))
        writer.finish({"ended": "stopped", "rows_pushed": 20})
        return path.read_bytes()


def _json_mcap() -> bytes:
    from mcap.writer import Writer

    out = io.BytesIO()
    writer = Writer(out)
    writer.start()
    schema = writer.register_schema("log", "jsonschema", b"{}")
    channel = writer.register_channel("log", "json", schema)
    for k in range(10):
        writer.add_message(channel, k, json.dumps({"x": k, "y": [k, 2]}).encode(), k)
    writer.finish()
    return out.getvalue()


_DESCRIPTOR = (
    """format = 1
data = "data.csv"
rate_hz = 1000.0
[twin]
kind = "static"
"""
    + channel("x", "input", "u", "V")
    + channel("y", "output", "y", "V")
)
