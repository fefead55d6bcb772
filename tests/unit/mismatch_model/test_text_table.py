"""Text tables as instruments write them: each form gives the same numbers, and what is no table is one message."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from tools.errors import RecordingError
from tools.mismatch.text_table import text_table

N = 120
T, U, Y = np.arange(N) * 0.01, np.sin(np.arange(N) * 0.1), 20.0 + np.cos(np.arange(N) * 0.1)


def body(delimiter: str, decimal: str = ".", extra: str = "") -> str:
    rows = (delimiter.join(f"{v:.6f}" for v in row) for row in zip(T, U, Y, strict=True))
    return "\n".join(row.replace(".", decimal) + extra for row in rows) + "\n"


FORMS = {
    "comma": ("t,u,y\n" + body(","), ("t", "u", "y")),
    "spaces after commas": ("t, u, y\n" + body(", "), ("t", "u", "y")),
    "semicolon": ("t;u;y\n" + body(";"), ("t", "u", "y")),
    "decimal comma": ("t;u;y\n" + body(";", ","), ("t", "u", "y")),
    "decimal comma, tab": ("t\tu\ty\n" + body("\t", ","), ("t", "u", "y")),
    "decimal comma, blanks": ("t u y\n" + body(" ", ","), ("t", "u", "y")),
    "a header with commas": ("t, s;u, V;y, um\n" + body(";", ","), ("t, s", "u, V", "y, um")),
    "numpy.savetxt": ("# t u y\n" + body(" "), ("t", "u", "y")),
    "no header": (body(","), ("column_1", "column_2", "column_3")),
    "no header, bars": (body("|"), ("column_1", "column_2", "column_3")),
    "quoted": ('"t","u","y, in place"\n' + body(","), ("t", "u", "y, in place")),
    "lines end with a delimiter": ("t;u;y;\n" + body(";", extra=";"), ("t", "u", "y")),
    "something above": ("Operator: K. Meier\nRig 7\n\nt,u,y\n" + body(","), ("t", "u", "y")),
    "names with blanks": ("Time (s)   Drive (V)   Path (um)\n" + body("   "), ("Time (s)", "Drive (V)", "Path (um)")),
    "DOS line ends": (("t,u,y\n" + body(",")).replace("\n", "\r\n"), ("t", "u", "y")),
}


@pytest.mark.parametrize(("text", "names"), FORMS.values(), ids=FORMS)
def test_every_form_gives_the_same_numbers(tmp_path: Path, text: str, names: tuple[str, ...]):
    path = tmp_path / "a.csv"
    path.write_bytes(text.encode())
    table = text_table(path)
    assert table.names == names
    found = table.read(list(names))
    for name, values in zip(names, (T, U, Y), strict=True):
        np.testing.assert_allclose(found[name], values, atol=1e-6)


def test_a_row_of_units(tmp_path: Path):
    (tmp_path / "a.txt").write_text("time\tforce\tpath\n[s]\t[N]\t[mm]\n" + body("\t"))
    table = text_table(tmp_path / "a.txt")
    assert (table.names, table.units, table.first) == (("time", "force", "path"), ("s", "N", "mm"), 3)


def test_dates_are_seconds(tmp_path: Path):
    rows = "".join(f"2026-03-10T10:{k // 60:02d}:{k % 60:02d}.250,{k}.5\n" for k in range(90))
    (tmp_path / "a.csv").write_text(f"when,y\n{rows}")
    table = text_table(tmp_path / "a.csv")
    assert (table.columns, table.dates, table.units, table.text) == (["when", "y"], ("when",), ("s", ""), ())
    found = table.read(["y", "when"])
    np.testing.assert_array_equal(found["when"], 1773136800.25 + np.arange(90))
    np.testing.assert_array_equal(found["y"], 0.5 + np.arange(90))


def test_a_broken_date_is_named_with_its_line(tmp_path: Path):
    rows = [f"2026-03-10 10:00:{k:02d},{k}\n" for k in range(60)]
    rows[7] = "2026-03-10 10:00:61,7\n"
    (tmp_path / "a.csv").write_text("when,y\n" + "".join(rows))
    with pytest.raises(RecordingError, match=r"line 9: column 'when': '2026-03-10 10:00:61' is no date like"):
        text_table(tmp_path / "a.csv").read(["when"])


def test_columns_of_words_are_named_and_left_out(tmp_path: Path):
    (tmp_path / "a.csv").write_text("t,state,y\n" + "".join(f"{k},running,{k}.5\n" for k in range(60)))
    table = text_table(tmp_path / "a.csv")
    assert table.columns == ["t", "y"]
    assert table.text == (("state", "running"),)


def test_missing_values_are_nan(tmp_path: Path):
    (tmp_path / "a.csv").write_text("t,y\n0,1\n1,\n2,n/a\n3,4\n4,5\n5,6\n")
    assert np.isnan(text_table(tmp_path / "a.csv").read(["y"])["y"]).tolist() == [False, True, True, *[False] * 3]


def test_units_of_a_windows_program(tmp_path: Path):
    (tmp_path / "a.csv").write_bytes("t;x [µm];T [°C]\n".encode("cp1252") + body(";", ",").encode())
    assert text_table(tmp_path / "a.csv").names == ("t", "x [µm]", "T [°C]")


def test_blocks_are_bounded_and_whole(tmp_path: Path):
    (tmp_path / "a.csv").write_text("t,u,y\n" + body(","))
    blocks = list(text_table(tmp_path / "a.csv").blocks(["y", "t"], rows=50))
    assert [b.shape for b in blocks] == [(50, 2), (50, 2), (20, 2)]
    np.testing.assert_allclose(np.concatenate(blocks)[:, 1], T, atol=1e-6)


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (b"t,y\n" + b"1,2\n" * 9 + b"3,x\n" + b"1,2\n" * 30, r"line 11: column 'y': 'x' is not a number"),
        (b"t,y\n" + b"1,2\n" * 9 + b"3\n" + b"1,2\n" * 30, r"line 11: 1 values, the header names 2"),
        (b"t,y\n\n 4,5\nERR,5\n" + b"1,2\n" * 9, r"line 4: column 't': 'ERR' is not a number"),
        (b"1,2,\x00\x00\n", "control bytes"),
        (b"1" * (3 << 20), "no line ends"),
        (b"t,y\n" + b"1,2\n" * 400_000 + b"\xff\xff\n", "not a UTF-8 text file"),
    ],
)  # fmt: skip
def test_what_is_no_table_is_one_message(tmp_path: Path, content: bytes, message: str):
    (tmp_path / "a.csv").write_bytes(content)
    with pytest.raises(RecordingError, match=message):
        text_table(tmp_path / "a.csv").read(["t", "y"])
