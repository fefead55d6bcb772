"""Recordings for viewers, read by readers that nobody here wrote: mcap, mcap-protobuf-support, rerun."""

from __future__ import annotations

import json
import re
import xml.etree.ElementTree as ET
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from mcap.reader import SeekingReader, make_reader
from typer.testing import CliRunner

from firmware_py.frame import LAYOUT
from firmware_py.recording.errors import RecordingError
from firmware_py.recording.reader import Recording
from firmware_py.recording.writer import RecordingWriter
from tests.unit.recording.samples import METADATA
from tools.cli.main import app
from tools.formats.export import LAYOUTS, export
from tools.formats.view import field_name, topics

pytest.importorskip("google.protobuf", reason="extra: pip install 'micron-bench[viewers]'")
COLUMNS = list(zip(LAYOUT.scalar_names(), LAYOUT.scalar_units(), strict=True))
N = 2350  # two chunks and a part of one


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Recording:
    rows = np.random.default_rng(5).normal(size=(N, len(COLUMNS)))
    rows[:, 0] = np.arange(N)
    rows[:, LAYOUT.start("t")] = 0.001 * np.arange(N) + 0.5
    rows[7, 5:9] = (np.nan, np.inf, -0.0, 5e-324)
    path = tmp_path_factory.mktemp("view") / "run.mcap"
    writer = RecordingWriter(path, COLUMNS, METADATA)
    for start in range(0, N, 100):
        writer.write_block(start, rows[start : start + 100])
    events = (
        {"event": "hold begins", "reason": "a line is silent", "tick": 1500, "t_ns": 9},
        {"event": "safe state", "reason": "run finished", "tick": N + 5, "t_ns": 9},
    )
    for number, event in enumerate(events):
        writer.write_event(number, event)
    writer.finish({"ended": "stopped", "rows_pushed": N, "rows_dropped": 0, "events_pushed": 2})
    return Recording(path)


@pytest.fixture(scope="module")
def view(run: Recording) -> Path:
    out = run.path.with_name("view.mcap")
    export(run, out)
    return out


def read(path: Path) -> dict[str, list[Any]]:
    """Messages by topic, in the order of time, decoded by the descriptors that the file embeds."""
    reader = pytest.importorskip("mcap_protobuf.reader", reason="a test of the extra dev")
    found: dict[str, list[Any]] = {}
    for message in reader.read_protobuf_messages(str(path)):
        found.setdefault(message.topic, []).append(message)
    return found


def test_every_value_comes_back_at_its_time(run: Recording, view: Path) -> None:
    messages = read(view)
    assert set(messages) == {t.name for t in topics(run.columns)} | {"/pose", "/events"}
    t_ns = np.rint(run.column("t") * 1e9).astype(np.int64)
    columns = run.arrays()
    for topic in topics(run.columns):
        assert len(messages[topic.name]) == N
        assert [m.log_time_ns for m in messages[topic.name]] == t_ns.tolist()
        for field, column in topic.fields:
            values = np.array([getattr(m.proto_msg, field) for m in messages[topic.name]])
            assert np.array_equal(values.view(np.uint64), columns[run.names[column]].view(np.uint64)), field
    fields = [field for topic in topics(run.columns) for field, _ in topic.fields]
    assert len(fields) == len(COLUMNS) - 1  # all but the time
    assert {"rate_x_rad_per_s", "tremor_x_m", "temperature_degC", "command_1_V", "quaternion_w"} <= set(fields)


def test_events_and_attitude_speak_foxglove(run: Recording, view: Path) -> None:
    messages = read(view)
    hold, end = (m.proto_msg for m in messages["/events"])
    assert hold.DESCRIPTOR.full_name == "foxglove.Log"
    assert "a line is silent" in hold.message
    assert (hold.level, end.level) == (3, 2)  # a warning; the end of a run is information
    assert hold.timestamp.ToNanoseconds() == 2_000_000_000  # when its tick was
    pose = messages["/pose"][123]
    assert pose.proto_msg.DESCRIPTOR.full_name == "foxglove.PoseInFrame"
    assert pose.proto_msg.frame_id == "world"
    assert pose.proto_msg.timestamp.ToNanoseconds() == pose.log_time_ns == 623_000_000
    turned = pose.proto_msg.pose.orientation
    assert [turned.w, turned.x, turned.y, turned.z] == run.array([f"quaternion_{p}" for p in "wxyz"])[123].tolist()
    assert pose.proto_msg.pose.HasField("position")


def test_indexes_and_summary_agree_with_the_messages(view: Path) -> None:
    with view.open("rb") as file:
        reader = make_reader(file, validate_crcs=True)
        assert isinstance(reader, SeekingReader)
        summary = reader.get_summary()
        assert summary is not None
        assert summary.statistics is not None
        counted: dict[int, int] = {}
        for _, channel, _message in reader.iter_messages():
            counted[channel.id] = counted.get(channel.id, 0) + 1
        assert counted == summary.statistics.channel_message_counts
        assert sum(counted.values()) == summary.statistics.message_count
        times = [m.log_time for _, _, m in reader.iter_messages()]
        assert times == sorted(times)
        assert next(iter(reader.iter_metadata())).metadata["bench"] == METADATA["bench"]
    data = view.read_bytes()
    for index in summary.chunk_indexes:  # what Foxglove seeks by
        for channel, offset in index.message_index_offsets.items():
            assert data[offset] == 0x07
            assert int.from_bytes(data[offset + 9 : offset + 11], "little") == channel


def test_other_columns_have_a_topic_and_sound_names(tmp_path: Path) -> None:
    columns = [("t", "s"), ("pos [mm]", "mm"), ("2nd", "m/s^2"), ("A", "%"), ("a", "%")]
    (topic,) = topics(columns)
    assert topic.name == "/other"
    assert [f for f, _ in topic.fields] == ["pos_mm_mm", "_2nd_m_per_s2", "A_percent", "a_percent_column4"]
    assert all(re.fullmatch(r"[A-Za-z_][A-Za-z0-9_]*", f) for f, _ in topic.fields)
    assert field_name("x", "µT") == "x_uT"


def test_the_layouts_name_what_a_view_has() -> None:
    known = {f"{t.name}.{field}" for t in topics(COLUMNS) for field, _ in t.fields}
    foxglove = json.loads((LAYOUTS / "micron.foxglove.json").read_text())
    drawn = [p["value"] for panel in foxglove["configById"].values() for p in panel.get("paths", ())]
    assert len(drawn) >= 20
    assert set(drawn) <= known
    placed = set(re.findall(r"[A-Za-z0-9]+![a-z]+", json.dumps(foxglove["layout"])))
    assert placed == set(foxglove["configById"])
    curves = [c.attrib["name"] for c in ET.parse(LAYOUTS / "micron.plotjuggler.xml").iter("curve")]
    assert len(curves) >= 20
    assert set(curves) <= {k.replace(".", "/") for k in known}


def test_the_command_writes_a_view_or_with_raw_a_recording(run: Recording, tmp_path: Path) -> None:
    def micron(*arguments: str) -> Any:
        return CliRunner().invoke(app, ["export", str(run.path), *arguments])

    assert micron(str(tmp_path / "view.mcap"), "--from", "1", "--to", "1.5").exit_code == 0
    assert len(read(tmp_path / "view.mcap")["/tip"]) == 500
    assert micron("--out", str(tmp_path / "part.mcap"), "--raw", "--from", "1", "--to", "1.5").exit_code == 0
    part = Recording(tmp_path / "part.mcap")
    assert np.array_equal(part.array(part.names), run.array(run.names)[500:1000], equal_nan=True)
    with pytest.raises(RecordingError, match="made for viewers has none; export with --raw"):
        Recording(tmp_path / "view.mcap")
    for wrong in ([], [str(tmp_path / "a.csv"), "--out", "b.csv"], [str(tmp_path / "a.csv"), "--raw"]):
        assert micron(*wrong).exit_code == 2


@pytest.mark.slow
def test_rerun_sees_typed_series(view: Path) -> None:
    chunk = pytest.importorskip("rerun.chunk", reason="extra: pip install 'micron-bench[clients]'")
    typed: set[str] = set()
    poses = texts = 0
    for part in chunk.McapReader(str(view)).stream():
        batch = part.to_record_batch()
        for column in batch.schema:
            kind = column.type
            while hasattr(kind, "value_type"):
                kind = kind.value_type
            if column.name.startswith("micron.") and column.name.endswith(":message"):
                typed |= {f"{part.entity_path}:{kind.field(k).name}" for k in range(kind.num_fields)
                          if str(kind.field(k).type) == "double"}  # fmt: skip
            poses += batch.num_rows if column.name == "InstancePoses3D:quaternions" else 0
            texts += batch.num_rows if column.name == "TextLog:text" else 0
    assert len(typed) == len(COLUMNS) - 1 >= 20
    assert "/tremor:tremor_x_m" in typed
    assert poses == N
    assert texts == 2
