"""The emulated E-727 with the vendor's own client."""

from __future__ import annotations

from pathlib import Path

import pytest

from tests.contract.emulated_client import need_client, run_client

pytestmark = [pytest.mark.realtime, pytest.mark.slow]

PROGRAM = """
import json, os, time
from pipython import GCSDevice, GCSError
from pipython.pidevice.interfaces.piserial import PISerial

QUERIES = ("IDN SAI SAI_ALL HLP HPA TVI FRF SPA SVO POS TMN TMX VER CST SVA VOL ONT MOV VEL PUN OVF CSV ERR").split()
told, refused = {}, {}
with PISerial(os.environ["MICRON_PIEZO0"], 115200) as gateway:
    pi = GCSDevice(gateway=gateway)
    for name in QUERIES:
        told[name] = getattr(pi, "q" + name)()
    told["servo_update_s"] = pi.qSPA("1", 0x0E000200)["1"][0x0E000200]
    pi.SVA({"2": 10.0})
    told["open_loop"] = pi.qSVA("2")["2"]
    pi.SVO({"1": True})
    pi.MOV("1", 5.0)
    began = time.monotonic()
    while pi.IsMoving("1")["1"] or not pi.qONT("1")["1"]:
        assert time.monotonic() - began < 20.0
    told["reached_um"] = pi.qPOS("1")["1"]
    calls = {
        "wave generator": lambda: pi.WGO(1, 1),
        "wave table": lambda: pi.WAV_SIN_P(1, 1, 100, "X", 50, 5.0, 0.0, 100),
        "too far": lambda: pi.MOV("1", 99.0),
        "no such axis": lambda: pi.MOV("9", 1.0),
        "servo on": lambda: pi.SVA("1", 1.0),
        "no such parameter": lambda: pi.SPA("1", 0x1, 1.0),
        "protected": lambda: pi.SPA("1", 0x07000001, 1.0),
        "stop": lambda: pi.STP(),
    }
    for what, call in calls.items():
        try:
            call()
            refused[what] = 0
        except GCSError as error:
            refused[what] = error.val
print(json.dumps({"told": told, "refused": refused}))
"""


def test_the_vendor_s_client(tmp_path: Path) -> None:
    need_client("pipython")
    seen = run_client(tmp_path, PROGRAM, has_other_amplifiers=False)
    told = seen["told"]
    assert "E-727" in told["IDN"]
    assert told["SAI"] == told["SAI_ALL"] == ["1", "2", "3"]
    assert told["FRF"] == {"1": True, "2": True, "3": True}
    assert told["TMX"] == {"1": 15.0, "2": 15.0, "3": 15.0}
    assert set("123") <= set(told["TVI"].strip())
    assert "MOV" in told["HLP"]
    assert "WGO" not in told["HLP"]
    assert "0x7000001=" in told["HPA"].replace("0x0", "0x")
    assert len(told["SPA"]["1"]) == 6
    assert told["servo_update_s"] == pytest.approx(50e-6)
    assert told["open_loop"] == 10.0
    assert told["reached_um"] == pytest.approx(5.0, abs=0.06)
    assert told["ERR"] == 0
    assert seen["refused"] == {
        "wave generator": 2,
        "wave table": 2,
        "too far": 7,
        "no such axis": 15,
        "servo on": 303,
        "no such parameter": 54,
        "protected": 60,
        "stop": 10,
    }
