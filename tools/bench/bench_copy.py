"""Makes a copy of a bench file with another calibration or a corrected twin. The original stays as it is."""

from __future__ import annotations

import json
import re
import tomllib
from pathlib import Path

from hal.bench import BenchFile, load_bench
from hal.errors import BenchError
from hal.trust import allow_name
from sim_devices.config import emulation_config
from sim_devices.plant_factory import stack_twins
from tools.output import write_text_atomic

_LIST = re.compile(r"^calibration\s*=\s*\[.*?\][^\n]*$", re.MULTILINE | re.DOTALL)
_TABLE = re.compile(r"^\[firmware\][^\n]*$", re.MULTILINE)
_EMULATION = re.compile(r"^\[emulation\][^\n]*$", re.MULTILINE)
_TWIN = re.compile(r"^twin\s*=\s*(\[.*?\]|[^\n]*)[^\n]*\n", re.MULTILINE | re.DOTALL)


def with_calibration(bench: BenchFile, calibration: Path, out: Path) -> Path:
    """Write ``out``: the bench with ``calibration`` as its last calibration file, paths made absolute."""
    wanted = [name for name in _calibrations(bench) if name != str(calibration)] + [str(calibration)]
    allow_name(calibration)
    write_text_atomic(out, _calibrated(bench, wanted))
    load_bench(out)
    return out


def with_twin(bench: BenchFile, twin: Path, out: Path) -> Path:
    """Write ``out``: the bench with a corrected twin (``micron mismatch apply``) in its stacks' place, paths absolute.

    BenchError for a bench without emulation, or a twin that its emulated world cannot run; nothing is written then.
    """
    description = bench.description.model_dump()
    if "provider" not in description["emulation"]:
        raise BenchError(f"{bench.path}: nothing is emulated there; a corrected twin runs on an emulated bench")
    file = str(twin.resolve())
    allow_name(twin)
    description["emulation"]["twin"] = file
    stack_twins(emulation_config(description), description)
    text = _calibrated(bench, _calibrations(bench))
    begin, end = _table_span(text)
    body = _TWIN.sub("", text[begin:end])
    text = f"{text[:begin]}\ntwin = {json.dumps(file)}{body}{text[end:]}"
    assert tomllib.loads(text)["emulation"]["twin"] == file
    write_text_atomic(out, text)
    return out


def _table_span(text: str) -> tuple[int, int]:
    """Return the span of the keys of ``[emulation]``, from the end of its own line to the next table."""
    match = _EMULATION.search(text)
    if match is None:
        raise BenchError("[emulation] must be a table of its own line to take a twin")
    after = re.search(r"^\[", text[match.end() :], re.MULTILINE)
    return match.end(), len(text) if after is None else match.end() + after.start()


def _calibrations(bench: BenchFile) -> list[str]:
    files = [bench.resolve(name) for name in bench.description.firmware.get("calibration", ())]
    for file in files:
        allow_name(file)  # the copy lies elsewhere
    return [str(file) for file in files]


def _calibrated(bench: BenchFile, wanted: list[str]) -> str:
    """Return the bench's text with these calibration files."""
    firmware = bench.description.firmware
    if not wanted:
        return bench.text
    line = f"calibration = {json.dumps(wanted)}"
    text = bench.text
    if "calibration" in firmware:
        text = _LIST.sub(lambda _: line, text, count=1)
    elif _TABLE.search(text):
        text = _TABLE.sub(lambda match: f"{match.group()}\n{line}", text, count=1)
    else:
        text = f"{text.rstrip()}\n\n[firmware]\n{line}\n"
    assert tomllib.loads(text)["firmware"]["calibration"] == wanted
    return text
