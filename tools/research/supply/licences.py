"""Licences of everything that is installed, as a page: ``python -m tools.research.supply.licences FILE``."""

from __future__ import annotations

import argparse
import re
import tomllib
from collections.abc import Iterable, Mapping
from email.message import Message
from importlib.metadata import Distribution, distributions
from pathlib import Path
from typing import NamedTuple, cast

OWN = ("micron-bench", "micron-research")
PYPROJECT = Path(__file__).resolve().parents[3] / "pyproject.toml"
COPYLEFT = re.compile(r"\b(LGPL|GPL|AGPL|MPL|Lesser General|Mozilla|General Public)", re.IGNORECASE)


class Part(NamedTuple):
    """Describes an installed distribution; ``direct``: in pyproject.toml; ``extra``: only for an optional extra."""

    name: str
    version: str
    licence: str
    direct: bool
    extra: str


def declared(pyproject: Path) -> dict[str, str]:
    """Packages that pyproject.toml names, and for which extra; without one: "" ."""
    project = tomllib.loads(pyproject.read_text(encoding="utf-8"))["project"]
    named: dict[str, str] = {}
    for extra, lines in [*project.get("optional-dependencies", {}).items(), ("", project["dependencies"])]:
        named |= {_plain(re.split(r"[^A-Za-z0-9_.-]", line)[0]): extra for line in lines}
    return named


def licence_of(distribution: Distribution) -> str:
    """SPDX expression, else classifiers, else the first line of the licence field, else of the licence file."""
    meta = cast(Message, distribution.metadata)
    if expression := meta.get("License-Expression"):
        return expression
    classes = [c.rsplit("::", 1)[-1].strip() for c in meta.get_all("Classifier") or [] if c.startswith("License ::")]
    if classes := [c for c in classes if c != "OSI Approved"]:
        return "; ".join(classes)
    text = meta.get("License") or ""
    if not text.strip():
        files = [f for f in distribution.files or [] if re.match(r"(LICEN[CS]E|COPYING)", f.name, re.IGNORECASE)]
        text = files[0].read_text(encoding="utf-8") if files else ""
    first = next((line.strip(" #*") for line in text.splitlines() if line.strip()), "")
    return first[:60] or "not stated"


def parts(found: Iterable[Distribution], named: Mapping[str, str]) -> list[Part]:
    """Return all distributions by name without our own; ``named`` is the result of ``declared``."""
    rows: dict[str, Part] = {}
    for d in found:
        name = d.metadata["Name"]
        key = _plain(name)
        if key not in OWN:
            rows[key] = Part(name, d.version, licence_of(d), key in named, named.get(key, ""))
    return [rows[key] for key in sorted(rows)]


def _plain(name: str) -> str:
    return re.sub(r"[-_.]+", "-", name).lower()


def page(rows: list[Part]) -> str:
    """Markdown."""
    copyleft = [p for p in rows if COPYLEFT.search(p.licence)]
    lines = [
        "# Licences",
        "",
        "Made by `python -m tools.research.supply.licences docs/licences.md` from what is installed for development.",
        "This project is Apache-2.0. uPlot (MIT) is in `tools/bench/static/vendor` with its licence beside it.",
        "axe-playwright-python brings axe-core (MPL-2.0), which only the tests of the page run.",
        "",
        "## Copyleft parts",
        "",
        "None is changed or copied into this project; each is used as a library that the user can replace (LGPL), or",
        "is a tool for development and tests.",
        "",
        "| package | version | licence | used for |",
        "|---|---|---|---|",
        *(f"| {p.name} | {p.version} | {p.licence} | {_use(p)} |" for p in copyleft),
        "",
        "## All",
        "",
        "| package | version | licence | named by |",
        "|---|---|---|---|",
        *(f"| {p.name} | {p.version} | {p.licence} | {_use(p)} |" for p in rows),
        "",
    ]
    return "\n".join(lines)


def _use(part: Part) -> str:
    if not part.direct:
        return "another package"
    return f"extra {part.extra}" if part.extra else "the program"


if __name__ == "__main__":
    parser = argparse.ArgumentParser(prog="python -m tools.research.supply.licences", description=__doc__)
    parser.add_argument("page", type=Path, help="file to write")
    parser.parse_args().page.write_text(page(parts(distributions(), declared(PYPROJECT))), encoding="utf-8")
