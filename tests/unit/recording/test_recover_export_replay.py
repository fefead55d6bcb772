"""Recovery, exports read back by other programs, replay bit for bit."""

from __future__ import annotations

import csv
import tomllib
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from mcap.reader import make_reader

from firmware_py.exit_codes import Exit
from firmware_py.recording.errors import RecordingError
from firmware_py.recording.reader import Recording
from firmware_py.recording.recover import recover
from firmware_py.recording.replay import Mismatch, replay
from firmware_py.recording.writer import RecordingWriter
from tests.unit.recording.samples import COLUMNS, METADATA, same_bits
from tools.formats.export import export, export_folder
from tools.mismatch.recording_load import load

WriteFile = Callable[..., tuple[Path, np.ndarray]]
NAMES = [name for name, _ in COLUMNS]


class TestRecover:
    def test_a_killed_recording_becomes_a_finished_one(self, write_file: WriteFile, tmp_path: Path) -> None:
        path, rows = write_file(700, close=False)
        path.write_bytes(path.read_bytes() + b"\x06\xff")  # torn in the next record
        out = tmp_path / "recovered.mcap"
        report = recover(path, out)
        assert (report.rows, report.events, report.exit_code) == (700, 2, Exit.DATA_LOST)
        assert "up to 0.2 s after the last tick may be missing" in "\n".join(report.lines())
        recovered = Recording(out)
        assert same_bits(recovered.array(NAMES), rows)
        assert recovered.metadata["recovered"]["rows"] == 700
        assert {k: recovered.metadata[k] for k in METADATA} == METADATA
        assert [(e.number, e.time_ns, e.content) for e in recovered.events] == [
            (e.number, e.time_ns, e.content) for e in Recording(path).events
        ]
        with out.open("rb") as file:  # an ordinary reader opens it
            summary = make_reader(file).get_summary()
        assert summary is not None
        assert summary.statistics is not None
        assert summary.statistics.message_count == 7 + 2

    def test_a_whole_recording_loses_nothing(self, write_file: WriteFile, tmp_path: Path) -> None:
        path, rows = write_file(300)
        report = recover(path, tmp_path / "out.mcap")
        assert report.exit_code == Exit.DONE
        assert "nothing is missing" in report.lines()[-1]
        recovered = Recording(tmp_path / "out.mcap")
        assert same_bits(recovered.array(NAMES), rows)
        assert recovered.metadata["statistics"] == {"ticks": 300}
        assert not recovered.health.lost

    def test_a_hole_stays_a_hole(self, write_file: WriteFile, tmp_path: Path) -> None:
        path, _ = write_file(500)
        data = bytearray(path.read_bytes())
        with path.open("rb") as file:
            summary = make_reader(file).get_summary()
        assert summary is not None
        data[summary.chunk_indexes[2].chunk_start_offset + 200] ^= 1
        path.write_bytes(data)
        report = recover(path, tmp_path / "out.mcap")
        assert report.exit_code == Exit.DATA_LOST
        assert report.health.missing_rows == 100
        assert Recording(tmp_path / "out.mcap").health.row_gaps == report.health.row_gaps

    def test_garbage_leaves_nothing_behind(self, tmp_path: Path) -> None:
        path = tmp_path / "garbage.mcap"
        path.write_bytes(b"not at all")
        with pytest.raises(RecordingError, match="is not a recording"):
            recover(path, tmp_path / "out.mcap")
        assert [p.name for p in tmp_path.iterdir()] == ["garbage.mcap"]

    def test_never_onto_itself_or_onto_another_file(self, write_file: WriteFile, tmp_path: Path) -> None:
        path, _ = write_file(100)
        with pytest.raises(RecordingError, match="onto itself"):
            recover(path, path)
        other = tmp_path / "other.mcap"
        other.write_bytes(b"precious")
        with pytest.raises(RecordingError, match="exists already"):
            recover(path, other)
        assert other.read_bytes() == b"precious"


class TestExport:
    def test_csv_keeps_every_finite_value(self, write_file: WriteFile, tmp_path: Path) -> None:
        path, rows = write_file(250)
        report = export(Recording(path), tmp_path / "run.csv")
        assert (report.format, report.rows, report.columns) == ("csv", 250, 5)
        with (tmp_path / "run.csv").open(newline="") as file:
            header, *lines = csv.reader(file)
        assert header == NAMES
        values = np.array(lines, dtype=np.float64)
        finite = np.isfinite(rows)
        assert same_bits(values[finite], rows[finite])
        assert np.array_equal(np.isnan(values), np.isnan(rows))

    def test_npz_keeps_every_bit(self, write_file: WriteFile, tmp_path: Path) -> None:
        path, rows = write_file(250)
        export(Recording(path), tmp_path / "run.npz")
        with np.load(tmp_path / "run.npz", allow_pickle=False) as data:
            assert data.files == NAMES
            assert same_bits(np.column_stack([data[n] for n in NAMES]), rows)

    def test_parquet_keeps_every_bit_and_the_units(self, write_file: WriteFile, tmp_path: Path) -> None:
        pq = pytest.importorskip("pyarrow.parquet", reason="pyarrow is an extra: pip install 'micron-bench[parquet]'")
        path, rows = write_file(250)
        export(Recording(path), tmp_path / "run.parquet")
        table = pq.read_table(tmp_path / "run.parquet")
        assert table.column_names == NAMES
        assert same_bits(np.column_stack([table[n].to_numpy() for n in NAMES]), rows)
        assert table.schema.field("volts_0").metadata == {b"unit": b"V"}

    def test_the_contract_folder(self, tmp_path: Path) -> None:
        rows = np.arange(1500.0).reshape(300, 5)
        rows[7, 4] = np.nan
        path = tmp_path / "run.mcap"
        columns = [
            ("tick", "1"),
            ("t", "s"),
            ("volts_0", "V"),
            ("command_1", "V"),
            ("tremor_x", "m"),
            ("status", "bits"),
        ]
        writer = RecordingWriter(path, columns, METADATA)
        writer.write_block(0, np.column_stack([rows, rows[:, 0]]))
        writer.finish({"ended": "stopped", "rows_pushed": 300})
        report = export(Recording(path), tmp_path / "for_mismatch")
        text = tomllib.loads((tmp_path / "for_mismatch" / "recording.toml").read_text(encoding="utf-8"))
        assert (text["format"], text["data"], text["time_column"]) == (1, "data.npz", "t")
        assert text["twin"] == {"kind": "instrument", "parameters": {"bench": "bench.toml"}}
        assert (tmp_path / "for_mismatch" / "bench.toml").read_text(encoding="utf-8") == METADATA["bench"]
        assert text["channels"] == [
            {"column": "volts_0", "role": "output", "signal": "volts_0", "unit": "V"},
            {"column": "command_1", "role": "input", "signal": "command_1", "unit": "V"},
        ]
        assert len(report.notes) == 3
        assert "tremor_x is not a finite number throughout" in report.notes[0]
        assert "status holds flags" in report.notes[1]
        assert "1 columns that the firmware computed" in report.notes[2]
        with np.load(tmp_path / "for_mismatch" / "data.npz", allow_pickle=False) as data:
            assert same_bits(data["tremor_x"], rows[:, 4])
        loaded = load(tmp_path / "for_mismatch")  # the mismatch tool itself takes it
        assert loaded.twin.kind == "instrument"
        assert list(loaded.outputs) == ["volts_0"]

    def test_a_failed_export_leaves_nothing_behind(
        self, write_file: WriteFile, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        path, _ = write_file(500)
        recording = Recording(path)
        blocks = recording.blocks

        def breaks() -> Any:
            for i, block in enumerate(blocks()):
                if i == 3:
                    raise OSError(28, "No space left on device")
                yield block

        monkeypatch.setattr(recording, "blocks", breaks)
        for name in ("run.csv", "run.npz", "run.parquet"):
            with pytest.raises(RecordingError, match="No space left on device"):
                export(recording, tmp_path / name)
        assert [p.name for p in tmp_path.iterdir()] == ["run.mcap"]

    @pytest.mark.parametrize("name", ["run.csv", "folder"])
    def test_existing_results_are_kept(self, write_file: WriteFile, tmp_path: Path, name: str) -> None:
        path, _ = write_file(100)
        (tmp_path / "folder").mkdir()
        (tmp_path / "run.csv").write_text("precious")
        with pytest.raises(RecordingError, match="exists already"):
            export(Recording(path), tmp_path / name)
        assert (tmp_path / "run.csv").read_text() == "precious"

    def test_an_unknown_format_names_the_known_ones(self, write_file: WriteFile, tmp_path: Path) -> None:
        path, _ = write_file(100)
        with pytest.raises(RecordingError, match="'xlsx' is unknown; use csv, npz, parquet, nc, mf4, mcap or folder"):
            export(Recording(path), tmp_path / "run.xlsx")


class Filter:
    """A small filter with memory: two inputs, two outputs."""

    def __init__(self) -> None:
        self.state = 0.0

    def step(self, inputs: np.ndarray) -> np.ndarray:
        self.state = 0.9 * self.state + 0.1 * inputs[0]
        return np.array([self.state, self.state * inputs[1]])

    def run(self, rows: np.ndarray) -> np.ndarray:
        return np.array([self.step(row) for row in rows])


def record(path: Path, n: int, *, lost: range = range(0), change: tuple[int, float] | None = None) -> Recording:
    rng = np.random.default_rng(1)
    rows = rng.normal(size=(n, 4))
    live = Filter()
    for row in rows:
        row[2:] = live.step(row[:2])
    if change is not None:
        rows[change[0], 3] = change[1]
    writer = RecordingWriter(path, [("a", "V"), ("b", "V"), ("x", "m"), ("y", "m")], {})
    keep = np.array([i for i in range(n) if i not in lost])
    for part in np.split(keep, np.flatnonzero(np.diff(keep) != 1) + 1):
        for start in range(0, len(part), 100):
            numbers = part[start : start + 100]
            writer.write_block(int(numbers[0]), rows[numbers])
    writer.finish({"ended": "stopped", "rows_pushed": n})
    return Recording(path)


class TestReplay:
    def test_the_same_filter_gives_the_same_bits(self, tmp_path: Path) -> None:
        report = replay(record(tmp_path / "r.mcap", 350), Filter().run, ["a", "b"], ["x", "y"])
        assert (report.rows, report.mismatching_rows, report.left_out, report.identical) == (350, 0, 0, True)

    def test_one_changed_bit_is_found_and_named(self, tmp_path: Path) -> None:
        good = record(tmp_path / "good.mcap", 350).column("y")[222]
        changed = float(np.nextafter(good, np.inf))
        recording = record(tmp_path / "r.mcap", 350, change=(222, changed))
        report = replay(recording, Filter().run, ["a", "b"], ["x", "y"])
        assert report.first == Mismatch(222, "y", changed, good)
        assert report.mismatching_rows == 1
        assert report.as_dict()["first_mismatch"]["recorded_hex"] == changed.hex()

    def test_nothing_is_compared_behind_a_gap(self, tmp_path: Path) -> None:
        recording = record(tmp_path / "r.mcap", 350, lost=range(130, 140))
        report = replay(recording, Filter().run, ["a", "b"], ["x", "y"])
        assert (report.rows, report.identical, report.left_out) == (130, True, 210)

    def test_a_missing_beginning_leaves_nothing_to_compare(self, tmp_path: Path) -> None:
        recording = record(tmp_path / "r.mcap", 350, lost=range(10))
        assert replay(recording, Filter().run, ["a", "b"], ["x"]).rows == 0

    def test_nan_equals_itself_and_zero_has_a_sign(self, tmp_path: Path) -> None:
        path = tmp_path / "r.mcap"
        writer = RecordingWriter(path, [("a", "1"), ("x", "1")], {})
        writer.write_block(0, np.array([[1.0, np.nan], [2.0, 0.0], [3.0, 0.0]]))
        writer.finish({"ended": "stopped", "rows_pushed": 3})
        outputs = np.array([[np.nan], [0.0], [-0.0]])
        report = replay(Recording(path), lambda _: outputs, ["a"], ["x"])
        assert (report.mismatching_rows, report.first) == (1, Mismatch(2, "x", 0.0, -0.0))

    def test_a_missing_column_is_named(self, tmp_path: Path) -> None:
        with pytest.raises(RecordingError, match="no column 'z', which a replay needs"):
            replay(record(tmp_path / "r.mcap", 100), Filter().run, ["a", "z"], ["x"])


def test_a_folder_needs_inputs_and_outputs(tmp_path: Path) -> None:
    recording = record(tmp_path / "r.mcap", 100)
    with pytest.raises(RecordingError, match="no column has the role 'input'"):
        export_folder(recording, tmp_path / "folder")
    assert not (tmp_path / "folder").exists()


def test_writing_needs_no_rows_to_be_finite(tmp_path: Path) -> None:
    path = tmp_path / "r.mcap"
    writer = RecordingWriter(path, [("tick", "1"), ("t", "s")], {})
    writer.write_block(0, np.full((3, 2), np.nan))
    writer.finish({"ended": "stopped", "rows_pushed": 3})
    assert np.isnan(Recording(path).array(["tick", "t"])).all()
