"""A bench file with another calibration laid over it: a copy, the original stays as it is."""

from __future__ import annotations

import json
import re
import tomllib
from pathlib import Path

from hal.bench import BenchFile, load_bench
from tools.cli.common import write_text_atomic

_LIST = re.compile(r"^calibration\s*=\s*\[.*?\][^\n]*$", re.MULTILINE | re.DOTALL)
_TABLE = re.compile(r"^\[firmware\][^\n]*$", re.MULTILINE)


def with_calibration(bench: BenchFile, calibration: Path, out: Path) -> Path:
    """Write ``out``: the bench with ``calibration`` as its last calibration file, paths made absolute."""
    firmware = bench.description.firmware
    files = [str(bench.resolve(name)) for name in firmware.get("calibration", ())]
    wanted = [name for name in files if name != str(calibration)] + [str(calibration)]
    line = f"calibration = {json.dumps(wanted)}"
    text = bench.text
    if "calibration" in firmware:
        text = _LIST.sub(lambda _: line, text, count=1)
    elif _TABLE.search(text):
        text = _TABLE.sub(lambda found: f"{found.group()}\n{line}", text, count=1)
    else:
        text = f"{text.rstrip()}\n\n[firmware]\n{line}\n"
    assert tomllib.loads(text)["firmware"]["calibration"] == wanted
    write_text_atomic(out, text)
    load_bench(out)
    return out
