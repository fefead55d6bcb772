"""Licences and audit: from what packages and pip-audit say to a page and a status."""

from __future__ import annotations

import re
from email.message import Message
from importlib.metadata import Distribution
from typing import Any

from tools.research.supply.audit import CONSTRAINTS, audited, findings, statement, verdict
from tools.research.supply.licences import PYPROJECT, declared, page, parts


class Package(Distribution):
    """An installed distribution that consists of its metadata."""

    def __init__(self, name: str, **fields: str) -> None:
        self._meta = Message()
        for key, value in {"Name": name, "Version": "1.0", **fields}.items():
            self._meta[key.replace("_", "-")] = value

    def read_text(self, filename: str) -> str | None:
        return str(self._meta) if filename == "METADATA" else None

    def locate_file(self, path: Any) -> Any:
        raise FileNotFoundError(path)


def test_a_copyleft_part_is_named_and_where_it_is_used():
    found = [
        Package("python-can", License_Expression="LGPL-3.0-only"),
        Package("numpy", License="BSD-3-Clause\nlong text"),
        Package("silent"),
        Package("micron-bench", License_Expression="Apache-2.0"),
    ]
    rows = parts(found, {"python-can": "", "numpy": ""})
    assert [(p.name, p.licence, p.direct) for p in rows] == [
        ("numpy", "BSD-3-Clause", True),
        ("python-can", "LGPL-3.0-only", True),
        ("silent", "not stated", False),
    ]
    copyleft, everything = page(rows).split("## All")
    assert "| python-can | 1.0 | LGPL-3.0-only | the program |" in copyleft
    assert "numpy" not in copyleft.split("## Copyleft parts")[1]
    assert "silent" in everything


def test_what_pyproject_names_is_known_with_its_extra():
    named = declared(PYPROJECT)
    assert named["python-can"] == ""
    assert named["pytest"] == "dev"


REPORT = {
    "dependencies": [
        {"name": "good", "version": "1.0", "vulns": []},
        {"name": "local", "skip_reason": "not on the index"},
        {"name": "old", "version": "0.9", "vulns": [{"id": "PYSEC-1", "fix_versions": ["1.0"]}]},
        {"name": "sad", "version": "2.0", "vulns": [{"id": "PYSEC-2", "fix_versions": []}]},
    ]
}


def test_only_a_vulnerability_with_a_repair_fails_the_audit():
    found = findings(REPORT)
    assert [(f.package, f.number, f.repaired_in) for f in found] == [
        ("old", "PYSEC-1", ("1.0",)),
        ("sad", "PYSEC-2", ()),
    ]
    assert verdict(found) == 1
    assert verdict(found[1:]) == 0
    assert verdict([]) == 0


def test_what_the_database_does_not_know_is_not_audited():
    assert audited(REPORT) == 3


def test_an_audit_of_no_package_is_no_clean_result():
    """An index without the database of PyPI answered "not found" for each: this read as no vulnerabilities."""
    none = {"dependencies": [{"name": n, "skip_reason": "Dependency not found on PyPI"} for n in ("one", "two")]}
    assert statement("installed", none).startswith("installed: audit skipped: ")
    assert statement("installed", REPORT) == "installed: 3 of 4 packages audited, 2 known vulnerabilities"


def pins(text: str) -> dict[str, list[str]]:
    """Hashes by package; a line that is no exact pin fails."""
    found: dict[str, list[str]] = {}
    for entry in text.replace("\\\n", " ").splitlines():
        if entry.strip() and not entry.startswith("#"):
            match = re.fullmatch(r"([a-z0-9-]+)==[^ ;]+( ; [^-]+?)?((?: +--hash=sha256:[0-9a-f]{64})+) *", entry)
            assert match, entry[:100]
            found[match[1]] = match[3].split()
    return found


def test_every_package_of_every_extra_is_pinned_with_hashes():
    pinned = pins(CONSTRAINTS.read_text())
    assert {name.lower().replace("_", "-") for name in declared(PYPROJECT)} <= set(pinned)
    assert {"hatchling", "editables"} <= set(pinned)  # what builds the package
    assert len(pins((CONSTRAINTS.parent / "uv-pin.txt").read_text())["uv"]) > 10


def test_nothing_is_installed_without_its_hash():
    """The one thing before uv is uv."""
    makefile = (CONSTRAINTS.parent / "Makefile").read_text()
    for line in makefile.splitlines():
        if "pip install" in line:
            assert "--require-hashes" in line or "-c constraints.txt -b constraints.txt" in line, line
