"""netCDF, MDF and parquet: every bit and unit comes back, in these readers and in the formats' own libraries."""

from __future__ import annotations

import contextlib
import html
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from firmware_py.recording.reader import Recording
from firmware_py.recording.writer import RecordingWriter
from tests.command import micron
from tests.unit.recording.samples import COLUMNS, METADATA, make_rows, same_bits
from tools.bench import open_run
from tools.calibrate.logs import load_log
from tools.errors import InputError, RecordingError
from tools.formats.export import export
from tools.formats.netcdf import dataset
from tools.mismatch.guess import guess
from tools.mismatch.recording_columns import column_names, column_units, read_columns
from tools.mismatch.recording_load import load

NAMES = [name for name, _ in COLUMNS]
PACKAGE = {"nc": "h5netcdf", "mf4": "asammdf", "parquet": "pyarrow"}
ENDINGS = sorted(PACKAGE)


def need(ending: str) -> Any:
    return pytest.importorskip(PACKAGE[ending], reason="extra: pip install 'micron-bench[lab]'")


@pytest.fixture
def run(tmp_path: Path) -> Recording:
    rows = make_rows(25_000)  # more than one batch of the writers
    writer = RecordingWriter(tmp_path / "run.mcap", COLUMNS, METADATA)
    for start in range(0, len(rows), 100):
        writer.write_block(start, rows[start : start + 100])
    writer.write_event(0, {"event": "mark", "t_ns": 1_500_000, "tick": 123})
    writer.finish({"ended": "stopped", "rows_pushed": len(rows), "rows_dropped": 0, "events_pushed": 1})
    return Recording(tmp_path / "run.mcap")


@pytest.mark.parametrize("ending", ENDINGS)
def test_every_bit_and_unit_comes_back(run: Recording, tmp_path: Path, ending: str):
    need(ending)
    out = tmp_path / f"out.{ending}"
    report = export(run, out)
    assert (report.rows, report.columns) == (25_000, 5)
    assert set(column_names(out)) == set(NAMES)
    back = read_columns(out, NAMES)
    assert same_bits(np.column_stack([back[n] for n in NAMES]), run.array(NAMES))
    assert column_units(out) == dict(COLUMNS)


@pytest.mark.parametrize("ending", ENDINGS)
def test_a_missing_column_is_named_beside_those_that_are_there(run: Recording, tmp_path: Path, ending: str):
    need(ending)
    export(run, tmp_path / f"out.{ending}")
    with pytest.raises(RecordingError, match=r"no column 'nope'; the file has: .*volts_0"):
        read_columns(tmp_path / f"out.{ending}", ["volts_0", "nope"])


@pytest.mark.parametrize("ending", ENDINGS)
def test_torn_and_foreign_files_get_one_message(run: Recording, tmp_path: Path, ending: str):
    need(ending)
    sound = tmp_path / f"sound.{ending}"
    export(run, sound)
    data = sound.read_bytes()
    torn = tmp_path / f"torn.{ending}"
    for length in (0, 7, 100, len(data) // 3, len(data) - 200):
        torn.write_bytes(data[:length])
        with pytest.raises(RecordingError) as caught:
            read_columns(torn, ["volts_0"])
        assert str(torn) in str(caught.value)
        assert "\n" not in str(caught.value)
    torn.write_bytes(b"time,volts_0\n0,1\n" * 100)
    result = micron("noise", torn, "--rate-hz", "100")
    assert result.exit_code == 2
    assert result.stderr.count("\n") == 1
    assert f"torn.{ending}: not a" in result.stderr


@pytest.mark.parametrize("ending", ENDINGS)
def test_without_its_package_a_message_says_how_to_get_it(
    run: Recording, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, ending: str
):
    need(ending)
    out = tmp_path / f"out.{ending}"
    export(run, out)

    def missing(name: str, package: str | None = None) -> Any:
        raise ImportError(name)

    monkeypatch.setattr("importlib.import_module", missing)
    with pytest.raises(InputError, match=r"pip install 'micron-bench\[(lab|parquet)\]'"):
        read_columns(out, ["volts_0"])
    with pytest.raises(InputError, match=r"pip install 'micron-bench\[(lab|parquet)\]'"):
        export(run, tmp_path / f"other.{ending}")
    assert not (tmp_path / f"other.{ending}").exists()


@pytest.mark.parametrize("ending", ENDINGS)
def test_a_diagnosis_takes_the_units_of_the_file(tmp_path: Path, ending: str):
    need(ending)
    t = np.arange(400) / 1000
    rows = np.column_stack([t, 10 * np.sin(30 * t), np.sin(30 * t) + 0.01 * np.cos(900 * t)])
    writer = RecordingWriter(tmp_path / "run.mcap", [("t", "s"), ("drive", "mV"), ("move", "nm")], {})
    writer.write_block(0, rows)
    writer.finish({"ended": "stopped", "rows_pushed": 400, "rows_dropped": 0, "events_pushed": 0})
    export(Recording(tmp_path / "run.mcap"), tmp_path / f"data.{ending}")
    (tmp_path / "recording.toml").write_text(
        f'format = 1\ndata = "data.{ending}"\ntime_column = "t"\n[twin]\nkind = "piezo_stack"\n'
        '[[channels]]\ncolumn = "drive"\nrole = "input"\nsignal = "command"\n'
        '[[channels]]\ncolumn = "move"\nrole = "output"\nsignal = "displacement"\n'
    )
    loaded = load(tmp_path)
    assert not loaded.warnings
    assert loaded.dt == pytest.approx(1e-3)
    np.testing.assert_allclose(loaded.inputs["command"], 1e-3 * rows[:, 1], rtol=1e-12)
    np.testing.assert_allclose(loaded.outputs["displacement"], 1e-3 * rows[:, 2], rtol=1e-12)
    log = load_log(tmp_path / f"data.{ending}")  # what noise and calibrate read
    assert log.units["move"] == "nm"
    assert log.need_rate() == pytest.approx(1000.0)


class TestNetcdf:
    def test_the_file_is_the_dataset(self, run: Recording, tmp_path: Path):
        need("nc")
        import xarray

        export(run, tmp_path / "out.nc")
        with xarray.open_dataset(tmp_path / "out.nc", engine="h5netcdf") as file:
            xarray.testing.assert_identical(file.load(), dataset(run))

    def test_a_run_is_opened_as_that_dataset(self, run: Recording):
        need("nc")
        found = open_run(str(run.path))
        assert same_bits(found.volts_0.values, run.column("volts_0"))
        assert found.identical(dataset(run))

    def test_it_says_what_it_holds_as_cf_asks(self, run: Recording):
        need("nc")
        found = dataset(run)
        assert found.attrs["Conventions"].startswith("CF-1.")
        assert "run.mcap" in found.attrs["history"]
        assert found.attrs["bench"] == METADATA["bench"]
        assert found.t.attrs == {"units": "s", "axis": "T", "long_name": "time since the start of the run"}
        assert found.volts_0.attrs == {"units": "V", "long_name": "converter inputs, 0"}
        assert found.status.attrs["units"] == "1"  # UDUNITS has no bits
        assert "1 GAP, 2 STALE" in found.status.attrs["comment"]
        assert float(found.event_t[0]) == pytest.approx(0.123)  # when its tick was

    def test_packed_values_missing_ones_dates_and_two_dimensions(self, tmp_path: Path):
        need("nc")
        import xarray

        path = tmp_path / "other.nc"
        xarray.Dataset(
            {
                "pressure": ("time", [1.0, 2.5, np.nan], {"units": "hPa"}),
                "accel": (("time", "axis"), np.arange(6.0).reshape(3, 2)),
                "station": ("name", np.array(["a", "b"], dtype=object)),
            },
            {"time": np.array(["2026-01-01T00:00:00", "2026-01-01T00:00:30", "2026-01-01T00:01:30"], "M8[ns]")},
        ).to_netcdf(
            path,
            engine="h5netcdf",
            encoding={
                "pressure": {"dtype": "i2", "scale_factor": 0.5, "_FillValue": -1},
                "time": {"units": "minutes since 2026-01-01", "dtype": "f8"},
            },
        )
        assert column_names(path) == ["time", "pressure", "accel_0", "accel_1"]
        found = read_columns(path, ["time", "pressure", "accel_1"])
        assert found["time"].tolist() == [0.0, 30.0, 90.0]
        assert column_units(path) == {"time": "s", "pressure": "hPa"}
        assert found["pressure"][:2].tolist() == [1.0, 2.5]
        assert np.isnan(found["pressure"][2])
        assert found["accel_1"].tolist() == [1.0, 3.0, 5.0]

    def test_the_classic_format_is_read_too(self, tmp_path: Path):
        need("nc")
        import xarray

        xarray.Dataset({"x": ("n", [1.0, 2.0])}).to_netcdf(tmp_path / "old.nc", engine="scipy")
        assert read_columns(tmp_path / "old.nc", ["x"])["x"].tolist() == [1.0, 2.0]

    @pytest.mark.parametrize("kind", ["link", "storage"])
    def test_data_in_another_file_are_refused(self, tmp_path: Path, kind: str):
        need("nc")
        import h5py

        (tmp_path / "secret").write_bytes(bytes(80))
        with h5py.File(tmp_path / "a.nc", "w") as file:
            file["good"] = np.arange(10.0)
            if kind == "link":
                file["bad"] = h5py.ExternalLink("secret", "/x")
            else:
                file.create_dataset("bad", (10,), "f8", external=[(str(tmp_path / "secret"), 0, 80)])
        with pytest.raises(RecordingError, match="'bad' is stored in another file"):
            read_columns(tmp_path / "a.nc", ["good"])


class TestMdf:
    def test_channels_of_several_rates(self, tmp_path: Path):
        need("mf4")
        from asammdf import MDF, Signal

        fast, slow = np.arange(100) * 0.01, np.arange(10) * 0.1
        path = tmp_path / "car.mf4"
        with MDF(version="4.10") as file:
            file.append([Signal(np.arange(100, dtype=np.int16), fast, name="speed", unit="km/h")])
            file.append([Signal(np.arange(10) * 0.5, slow, name="coolant", unit="degC")])
            states = {"val_0": 0, "text_0": "off", "val_1": 1, "text_1": "on", "default": b"unknown"}
            file.append([Signal(np.arange(100) % 2, fast, name="lamp", conversion=states)])
            file.save(path)
        assert column_names(path) == ["time", "speed", "lamp"]
        both = read_columns(path, ["time", "speed", "lamp"])
        assert both["speed"].tolist() == list(range(100))
        assert both["lamp"].tolist() == [0.0, 1.0] * 50
        np.testing.assert_allclose(both["time"], fast)
        assert read_columns(path, ["time", "coolant"])["time"].tolist() == slow.tolist()
        with pytest.raises(RecordingError, match=r"speed, coolant do not share one time base.*Resample"):
            read_columns(path, ["speed", "coolant"])

    def test_the_library_itself_sees_clock_units_and_provenance(self, run: Recording, tmp_path: Path):
        need("mf4")
        from asammdf import MDF

        export(run, tmp_path / "out.mf4")
        with MDF(tmp_path / "out.mf4") as file:
            signal = file.get("volts_0")
            assert signal.unit == "V"
            assert same_bits(signal.timestamps, run.column("t"))
            assert same_bits(signal.samples, run.column("volts_0"))
            assert '"event": "mark"' in html.unescape(file.header.comment)

    def test_the_library_prints_nothing_beside_our_message(
        self, run: Recording, tmp_path: Path, capfd: pytest.CaptureFixture[str]
    ):
        need("mf4")
        export(run, tmp_path / "out.mf4")
        data = (tmp_path / "out.mf4").read_bytes()
        assert b"##FH" in data
        for block in (b"##FH", b"##MD", b"##CG"):
            (tmp_path / "bad.mf4").write_bytes(data.replace(block, b"\0\0\0\0"))
            with contextlib.suppress(RecordingError):  # a file without its history is sound
                read_columns(tmp_path / "bad.mf4", ["volts_0"])
        assert capfd.readouterr() == ("", "")

    def test_an_unfinished_file_says_so(self, tmp_path: Path):
        (tmp_path / "a.mf4").write_bytes(b"UnFinMF 4.10    " + bytes(100))
        with pytest.raises(RecordingError, match="its recorder did not finish the file"):
            read_columns(tmp_path / "a.mf4", ["x"])


def test_parquet_times_are_seconds_and_empty_cells_nan(tmp_path: Path):
    pa = need("parquet")
    import pyarrow.parquet as pq

    path = tmp_path / "a.parquet"
    stamps = pa.array([0, 500_000, 1_500_000], pa.timestamp("us"))
    pq.write_table(pa.table({"when": stamps, "x": pa.array([1, None, 3]), "who": ["a", "b", "c"]}), path)
    assert column_names(path) == ["when", "x"]
    found = read_columns(path, ["when", "x"])
    assert found["when"].tolist() == [0.0, 0.5, 1.5]
    assert np.array_equal(found["x"], [1.0, np.nan, 3.0], equal_nan=True)
    with pytest.raises(RecordingError, match="column 'who' is object"):
        read_columns(path, ["who"])


def test_a_recording_of_ours_is_a_data_file_like_any_other(run: Recording) -> None:
    assert column_names(run.path) == list(run.names)
    assert column_units(run.path) == dict(COLUMNS)
    read = read_columns(run.path, [run.names[2], run.names[0]])
    assert list(read) == [run.names[2], run.names[0]]
    for name, values in read.items():
        assert np.array_equal(values, run.column(name), equal_nan=True)
    with pytest.raises(RecordingError, match="no column 'absent'"):
        read_columns(run.path, ["absent"])


def test_an_array_of_two_dimensions_in_an_npz_is_numbered_columns(tmp_path: Path) -> None:
    values = np.arange(12.0).reshape(4, 3)
    np.savez(tmp_path / "d.npz", a=values, t=np.arange(4), wide=np.zeros((4, 17)), one=np.float64(3.0))
    assert column_names(tmp_path / "d.npz") == ["a_0", "a_1", "a_2", "t"]
    assert read_columns(tmp_path / "d.npz", ["a_2"])["a_2"] == pytest.approx(values[:, 2])
    with pytest.raises(RecordingError, match=r"'wide' is float64 of shape \(4, 17\)"):
        read_columns(tmp_path / "d.npz", ["wide"])


def test_a_recording_of_ours_is_not_guessed_because_export_knows_it(run: Recording) -> None:
    with pytest.raises(RecordingError, match="a recording of micron run"):
        guess(run.path)


def test_a_unit_that_nobody_knows_is_said_and_left_out(tmp_path: Path) -> None:
    xarray = pytest.importorskip("xarray", reason="extra: pip install 'micron-bench[lab]'")
    t = np.arange(3000) * 1e-3
    drive = np.sin(9.0 * t) * 40.0 + 50.0
    columns = {"t": (t, "s"), "drive": (drive, "V"), "move": (0.1 * drive**1.01, "um"), "flags": (np.floor(t), "bits")}
    data = xarray.Dataset({name: ("row", values, {"units": unit}) for name, (values, unit) in columns.items()})
    data.to_netcdf(tmp_path / "d.nc", engine="h5netcdf")
    found = guess(tmp_path / "d.nc")
    assert "column 'flags': its unit 'bits' in the file is not known" in found.notes
    assert {c.name: c.unit for c in found.columns}["flags"] == ""


def test_the_descriptor_of_another_file_beside_it_says_nothing_of_a_log(run: Recording) -> None:
    other = 'data = "other.csv"\ntime_column = "time_s"\nrate_hz = 5.0\n'
    (run.path.parent / "recording.toml").write_text(other)
    assert load_log(run.path).time_column == "t"
    (run.path.parent / "recording.toml").write_text(other.replace("other.csv", run.path.name))
    with pytest.raises(InputError, match="time_column 'time_s' is no column"):
        load_log(run.path)
