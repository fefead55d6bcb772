"""``docs/results/tremor-on-real-hands.json``: every section is computed from the recordings; nothing in it is typed."""

from __future__ import annotations

from collections.abc import Callable
from importlib import import_module
from pathlib import Path
from textwrap import fill

from tools.errors import InputError
from tools.research.tremor.signal import TremorSignal
from tools.research.tremor.signals import load_data_sets

Progress = Callable[[str], None]
Section = Callable[[list[TremorSignal], Progress], list[str]]
"""Markdown lines, from '## heading' on."""

SECTIONS = {
    "inspect": "tools.research.tremor.report_inspect",
    "evaluate": "tools.research.tremor.report_evaluate",
    "published": "tools.research.tremor.report_published",
    "cascade": "tools.research.tremor.report_cascade",
    "detectors": "tools.research.tremor.report_detectors",
}
"""Modules whose ``section(signals, progress)`` writes a part of the page, in order."""


def _signals(data: Path) -> list[TremorSignal]:
    signals = load_data_sets(data) if data.is_dir() else []
    if not signals:
        raise InputError(f"{data}: no tremor recordings there; name the folder with --data FOLDER")
    return signals


def renewed(page: str, name: str, data: Path, revision: str, progress: Progress) -> str:
    """``page`` with the section ``name`` (of ``SECTIONS``) made again, and said so. Raises InputError.

    A section goes from its ``##`` heading to the next one.
    """
    signals = _signals(data)
    section: Section = import_module(SECTIONS[name]).section
    made = filled(section(signals, progress))
    made[1:1] = ["", f"This section: revision {revision}."]
    before = page.split("\n")
    if made[0] not in before:
        raise InputError(f"the page has no section '{made[0]}'; make it whole, without --section")
    start = before.index(made[0])
    stop = next((n for n in range(start + 1, len(before)) if before[n].startswith("## ")), len(before))
    return "\n".join([*before[:start], *made, "", *before[stop:]]).rstrip() + "\n"


def report(data: Path, revision: str, progress: Progress) -> str:
    """The page. Raises InputError when the recordings are not in ``data``."""
    signals = _signals(data)
    lines = [
        "# Tremor on real hands",
        "",
        f"Made by `micron tremor report --out docs/results/tremor-on-real-hands.json`, revision {revision}.",
        "",
    ]
    for name in SECTIONS.values():
        section: Section = import_module(name).section
        lines += [*filled(section(signals, progress)), ""]
    return "\n".join(lines).rstrip() + "\n"


def filled(lines: list[str]) -> list[str]:
    """Neighbouring lines of plain text joined and broken at 118 characters; headings, tables and lists as they are."""
    out: list[str] = []
    text: list[str] = []
    for line in [*lines, ""]:
        if line and line[0] not in "#|-":
            text.append(line)
            continue
        if text:
            out += fill(" ".join(text), 118, break_long_words=False, break_on_hyphens=False).split("\n")
            text = []
        out.append(line)
    return out[:-1]


def table(head: list[str], rows: list[list[str]]) -> list[str]:
    """A Markdown table, first column left, the others right."""
    rule = "|---|" + "---:|" * (len(head) - 1)
    return [f"| {' | '.join(head)} |", rule, *(f"| {' | '.join(row)} |" for row in rows)]
