"""Sources are cited by author and year; the folder numbers that they once had are in docs/references.md alone."""

from __future__ import annotations

import re
from pathlib import Path

ROOT = Path(__file__).parents[3]
ROOMS = ("firmware_py", "drivers", "hal", "sim_devices", "tests", "tools", "docs", "benches", "examples", "benchmarks")
KINDS = {".py", ".toml", ".md", ".json"}
# "(000" and "004, Table 2" cite; "10 000 s" counts and "PGA 000 (6.144 V)" is a field of a register.
NUMBER = re.compile(r"(?<![\w.,/-])(?<!\w )00[0124](?=$|,|\)|:|'s|;| \(| [A-Z]| sec| eq| ch)", re.M)


def cites(text: str) -> list[str]:
    return re.findall(r"\bERRATA\b", text) + NUMBER.findall(text)


def test_a_number_that_cites_is_told_from_one_that_counts():
    assert cites("000 (2.12)\n(004, Table 2)\nERRATA 5\n# 002") == ["ERRATA", "000", "004", "002"]
    assert not cites("10 000 s of it, PGA 000 (6.144 V), 1e-3 m, seed 1000 Hz, micron-004 x, 0.001 V")


def test_no_file_but_the_references_cites_a_number():
    found = {
        str(path.relative_to(ROOT)): cited
        for room in ROOMS
        for path in sorted((ROOT / room).rglob("*"))
        if path.suffix in KINDS and path.name not in {"references.md", Path(__file__).name}
        if (cited := cites(path.read_text(encoding="utf-8")))
    }
    assert not found, f"cite author and year instead (docs/references.md): {found}"
