"""Recordings as files: what loads, and one bad file for every error of the contract."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from tests.recording_text import channel
from tools.errors import RecordingError
from tools.mismatch.recording_load import load

GOOD = (
    """
format = 1
title = "piezo"
data = "data.csv"
rate_hz = 1000.0
[twin]
kind = "piezo_stack"
[twin.parameters]
gain_um_per_V = 0.125
"""
    + channel("command_mV", "input", "command", "mV")
    + channel("z", "output", "displacement", "nm", 70.0)
    + channel("temp", "context", "temperature", "K")
)


def rows(n: int = 80) -> list[str]:
    return ["t_s,command_mV,z,temp"] + [f"{0.001 * k:.3f},{100 * k},{12.5 * k},{298.15 + 0.01 * k}" for k in range(n)]


def write(folder: Path, text: str = GOOD, data: list[str] | None = None) -> Path:
    (folder / "recording.toml").write_text(text, encoding="utf-8")
    (folder / "data.csv").write_text("\n".join(rows() if data is None else data) + "\n", encoding="utf-8")
    return folder


def test_csv_is_converted(tmp_path: Path) -> None:
    r = load(write(tmp_path))
    assert (r.n, r.dt, r.title) == (80, 1e-3, "piezo")
    np.testing.assert_allclose(r.inputs["command"], 0.1 * np.arange(80))
    np.testing.assert_allclose(r.outputs["displacement"], 0.0125 * np.arange(80))
    np.testing.assert_allclose(r.context["temperature"], 25 + 0.01 * np.arange(80))
    assert r.noise == {"displacement": pytest.approx(0.07)}
    assert r.unit == {"command": "V", "displacement": "um", "temperature": "degC"}
    assert dict(r.twin.parameters) == {"gain_um_per_V": 0.125}


def test_the_keys_of_a_kind_may_stand_beside_it(tmp_path: Path) -> None:
    text = GOOD.replace("[twin.parameters]\n", 'hold = "zero"\n')
    assert dict(load(write(tmp_path, text)).twin.parameters) == {"gain_um_per_V": 0.125, "hold": "zero"}


def test_npz_and_time_column(tmp_path: Path) -> None:
    t = 5.0 + np.arange(100) * 0.01
    np.savez(tmp_path / "d.npz", t_s=t, command_mV=np.arange(100), z=np.arange(100) * 2.0, temp=t)
    text = GOOD.replace("data.csv", "d.npz").replace("rate_hz = 1000.0", 'time_column = "t_s"')
    (tmp_path / "r.toml").write_text(text)
    r = load(tmp_path / "r.toml")
    assert r.dt == pytest.approx(0.01)
    assert r.t[0] == 0.0


def test_mcap(tmp_path: Path) -> None:
    from mcap.writer import Writer

    with (tmp_path / "d.mcap").open("wb") as f:
        w = Writer(f)
        w.start()
        schema = w.register_schema("s", "jsonschema", b"{}")
        channel = w.register_channel("rec", "json", schema)
        for k in range(60):
            body = json.dumps({"u": k, "out": {"z": 2 * k}, "temp": [300 + k]}).encode()
            w.add_message(channel, log_time=k * 1_000_000, data=body, publish_time=0)
        w.finish()
    text = GOOD.replace("data.csv", "d.mcap").replace('"command_mV"', '"rec.u"').replace('"z"', '"rec.out.z"')
    (tmp_path / "r.toml").write_text(text.replace('"temp"', '"rec.temp.0"'))
    r = load(tmp_path / "r.toml")
    np.testing.assert_allclose(r.outputs["displacement"], 2e-3 * np.arange(60))


def test_split_names_other_recordings(tmp_path: Path) -> None:
    r = load(write(tmp_path, GOOD + '[split]\nfit = [0, 60]\ntest = "b.toml"\ninitialization = 5\n'))
    assert r.split.fit == (0, 60)
    assert r.split.test == tmp_path / "b.toml"
    assert r.split.initialization == 5


def _text(old: str, new: str) -> Callable[[Path], None]:
    return lambda folder: write(folder, GOOD.replace(old, new)) and None


def _line(k: int, text: str) -> Callable[[Path], None]:
    def make(folder: Path) -> None:
        data = rows()
        data[k] = text
        write(folder, data=data)

    return make


def _timed(k: int, stamp: str) -> Callable[[Path], None]:
    def make(folder: Path) -> None:
        data = rows()
        data[k] = stamp + data[k][5:]
        write(folder, GOOD.replace("rate_hz = 1000.0", 'time_column = "t_s"'), data)

    return make


def _same_numbers(folder: Path) -> None:
    write(folder, data=["command_mV,z,temp", *(f"{k},{k},{k}" for k in range(80))])


def _pickled(folder: Path) -> None:
    things = np.array([{"a": 1}] * 60, dtype=object)
    np.savez(folder / "data.npz", command_mV=things, z=np.arange(60), temp=np.arange(60))
    (folder / "recording.toml").write_text(GOOD.replace("data.csv", "data.npz"))


BAD: list[tuple[str, Callable[[Path], None], str]] = [
    ("no data file", _text("data.csv", "gone.csv"), r"gone\.csv: data file does not exist"),
    ("wrong kind of file", _text("data.csv", "recording.toml"), r"must be \.csv, .* or \.mf4"),
    ("toml syntax", _text("[twin]", "[twin"), r"recording\.toml: not valid TOML.*line"),
    ("format", _text("format = 1", "format = 2"), "format must be 1, got 2"),
    ("unknown unit", _text('"nm"', '"furlong"'), r"\[\[channels\]\] 2 \('z'\): unknown unit 'furlong'"),
    ("wrong dimension", _text('"nm"', '"V"'), "unit 'V' is not of the dimension of um"),
    ("missing column", _text('"z"', '"zz"'), r"data\.csv: no column 'zz'; the file has: t_s, command_mV, z, temp"),
    ("two channels, one signal", _text('signal = "temperature"', 'signal = "command"'), "signal 'command' is already"),
    ("two channels, one column", _text('column = "temp"', 'column = "z"'), "column 'z' is already used"),
    ("unknown signal", _text('"displacement"', '"voltage_x"'), "piezo_stack has no output 'voltage_x'"),
    ("unknown role", _text('"context"', '"extra"'), "role must be input, output or context, got 'extra'"),
    ("unknown twin", _text('"piezo_stack"', '"warp_drive"'), "kind 'warp_drive' is unknown; known kinds: piezo_stack"),
    ("no rate", _text("rate_hz = 1000.0", ""), "neither 'rate_hz' nor 'time_column'"),
    ("negative rate", _text("1000.0", "-5"), "rate_hz must be positive"),
    ("no output", _text('role = "output"', 'role = "context"'), "no channel has role = 'output'"),
    ("bad noise", _text("70.0", "-1"), "noise_rms must be positive"),
    ("NaN", _line(11, "0.01,1,nan,3"), r"column 'z' sample 10 \(line 12\): nan"),
    ("not a number", _line(5, "0.004,1,oops,3"), "line 6: column 'z': 'oops' is not a number"),
    ("short line", _line(5, "0.004,1"), "line 6: 2 values, the header names 4"),
    ("time backwards", _timed(20, "0.001"), r"'t_s' runs backwards at sample 19 .*mismatch cut .* sorts it"),
    ("time gap", _timed(80, "9.000"), r"time column 't_s' jumps by .* at sample 79"),
    ("too short", lambda f: write(f, data=rows(20)) and None, "20 samples; at least 50 .* 3 times the rate"),
    ("dead output", lambda f: write(f, data=[r.replace(r.split(",")[2], "7") if i else r for i, r in enumerate(rows())])
        and None, "never changes from"),
    ("input is output", _same_numbers, "hold the same numbers"),
    ("pickled", _pickled, "object of shape|pickled"),
    ("split outside", lambda f: write(f, GOOD + "[split]\nfit = [0, 999]\n") and None, r"\[0, 999\] must rise"),
    ("split falls", lambda f: write(f, GOOD + "[split]\ntest = [60, 50]\n") and None, r"\[60, 50\] must rise"),
    ("split word", lambda f: write(f, GOOD + '[split]\nfit = "half"\n') and None, "must be .start, stop. in samples"),
]  # fmt: skip


@pytest.mark.parametrize(("make", "message"), [b[1:] for b in BAD], ids=[b[0] for b in BAD])
def test_errors_name_file_and_place(tmp_path: Path, make: Callable[[Path], None], message: str) -> None:
    make(tmp_path)
    with pytest.raises(RecordingError, match=message) as caught:
        load(tmp_path)
    assert str(tmp_path) in str(caught.value)
    assert "\n" not in str(caught.value)


def test_no_such_recording(tmp_path: Path) -> None:
    with pytest.raises(RecordingError, match="no such recording"):
        load(tmp_path / "nothing.toml")
