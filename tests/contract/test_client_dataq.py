"""The emulated DI-4108 in the dialogue of the vendor's example programs: everything is set without waiting for an echo,
the echoes are thrown away, and ASCII lines or binary words are read until ``stop``."""

from __future__ import annotations

from pathlib import Path

import pytest

from tests.contract.emulated_client import run_client

pytestmark = [pytest.mark.realtime, pytest.mark.slow]

PROGRAM = """
import json, os, time
import serial

SETTINGS = ["slist %d %d" % (i, i) for i in range(8)] + ["srate 6000", "dec 10", "deca 3"]
seen = {}
for code, end in ((0, b"\\r"), (1, b"\\n"), (2, b"\\r\\n"), ("binary", b"")):
    with serial.Serial(os.environ["MICRON_DAQ0"], timeout=5.0) as port:
        mode = ["encode 0"] if code == "binary" else ["eol %s" % code, "encode 1"]
        for line in ["stop", *mode, *SETTINGS]:
            port.write(line.encode() + b"\\r")
        time.sleep(0.3)
        echoes = port.read_all()
        port.write(b"start\\r")
        if code == "binary":
            data = port.read(2 * 8 * 20)
        else:
            data = b"".join(port.read_until(end) for _ in range(20))
        port.write(b"stop\\r")
        rest = port.read_until(b"stop\\r")
        seen[code] = {"echoes": echoes.decode(), "data": data.decode("latin-1"), "stopped": rest.endswith(b"stop\\r")}
print(json.dumps(seen))
"""


def test_the_dialogue_of_the_vendor_s_examples(tmp_path: Path) -> None:
    seen = run_client(tmp_path, PROGRAM)
    for code, end in (("0", "\r"), ("1", "\n"), ("2", "\r\n")):
        assert f"eol {code}\r" in seen[code]["echoes"]
        lines = seen[code]["data"].split(end)[:-1]
        assert len(lines) == 20
        assert all(len(list(map(float, line.split(",")))) == 8 for line in lines)
    for mode in seen.values():
        assert "command not found" not in mode["echoes"]
        assert mode["stopped"]
    assert len(seen["binary"]["data"]) == 2 * 8 * 20
