"""TOML of a stranger: too deep, too long, without end, with numbers that are none. Each gets one message."""

from __future__ import annotations

import os
from pathlib import Path

import pytest

from firmware_py.control.plan import load_plan
from hal.bench import load_bench
from hal.errors import BenchError
from hal.toml_file import LARGEST_BYTES, parse_toml, read_text
from tests.conftest import DEFAULT_BENCH


@pytest.mark.parametrize(
    ("text", "says"),
    [
        ("x = " + "[" * 5000 + "]" * 5000, "within one another more than 20 deep"),
        ("[a" + ".b" * 3000 + "]", "within one another more than 20 deep"),
        ("x = " + "9" * 5000, "4300 digits"),
        ("[firmware.safety]\nstale_ms = " + "9" * 30, r"\[firmware.safety.stale_ms\] is larger than the 64 bits"),
        ("a = [1.0, nan]", r"\[a.1\] nan is not a finite number"),
        ("[a]\nb = -inf", r"\[a.b\] -inf is not a finite number"),
    ],
)
def test_what_is_no_table_of_numbers_is_refused(text: str, says: str):
    with pytest.raises(BenchError, match=says):
        parse_toml(text, "bench.toml")


def test_what_is_no_file_of_text_is_refused(tmp_path: Path):
    pipe, long, binary = tmp_path / "pipe", tmp_path / "long", tmp_path / "binary"
    os.mkfifo(pipe)  # reading it would wait for ever
    long.write_bytes(b"#" * (LARGEST_BYTES + 1))
    binary.write_bytes(b"\xff\xfe")
    for path, says in (
        (pipe, "no regular file"),
        (Path("/dev/zero"), "no regular file"),
        (tmp_path, "no regular file"),
        (tmp_path / "none", "not there"),
        (long, "longer than 1048576 bytes"),
        (binary, "utf-8"),
    ):
        with pytest.raises(BenchError, match=rf"cannot be read \(.*{says}.*\); name a file"):
            read_text(path, "name a file")


@pytest.mark.parametrize("name", ["a\\u0000b", "../../../../../dev/zero", "../../../etc/passwd", "/"])
def test_a_calibration_that_is_none_is_refused(tmp_path: Path, name: str):
    path = tmp_path / "bench.toml"
    path.write_text(DEFAULT_BENCH.read_text().replace("calibration/sensors.toml", name))
    with pytest.raises(BenchError):
        load_plan(load_bench(path))
