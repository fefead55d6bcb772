"""The page of all artefacts in ``docs/results``: ``python -m tools.research.results.page --out docs/results.md``.

With the path of an artefact instead (``... docs/results/reliability.json``) it prints the full page of that result;
with ``--into PAGE`` beside it, the head of the result replaces what stands in PAGE between ``<!-- NAME -->`` and
``<!-- end -->``.
"""

from __future__ import annotations

import argparse
import re
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from tools.errors import InputError
from tools.output import write_text_atomic
from tools.research.results.artefact import block_lines, load, to_markdown

FOLDER = Path("docs/results")
HEAD = """# Results

Made by `python -m tools.research.results.page --out docs/results.md` from the artefacts in `docs/results`; do not edit.
Each artefact holds all tables and notes of one result with its command, revision, day and seeds. With
`docs/results/NAME.json` in place of the option it prints one in full. Missed goals and doubts are shown here.
"""
SHOWN: dict[str, tuple[str, ...]] = {
    "hands": (),
    "heldout": (),
    "reliability": (
        "Answers that were not as expected",
        "What is not seen, or too late",
        "What any detector",
        "Beside it",
    ),
    "long-runs": ("30 min", "8 h"),
    "sensing": (),
    "tremor-on-real-hands": (
        "Shaker",
        "Wrist of a person",
        "Hands on a mouse",
        "A new hand",
        "Published figures",
        "Tables 5.1",
        "How much depends",
        "Jerk and drift",
    ),
    "mismatch-proof": ("What went wrong",),
    "mismatch-false-alarms": (),
    "mismatch-foreign": (),
    "mismatch-measured": (),
    "mismatch-found": ("A second set",),
    "mismatch-gate": ("First run", "Sure learned", "Start states", "A draw with constants"),
    "heal": ("Kept remedies", "Reverted remedies"),
    "plan": ("Why a planned", "By pair", "Pairs that"),
    "together": ("Not named",),
    "together-public": (),
    "watch": (),
}
"""The results in the page's order, each with the sections (by the begin of their titles) that the page shows whole.

The head of a result is always shown. An artefact that is not listed comes last, with its head alone.
"""
MISSED = "**no**"


def page(results: Sequence[dict[str, Any]]) -> str:
    """Return the Markdown of the results page."""
    order = {name: n for n, name in enumerate(SHOWN)}
    lines = [HEAD]
    for result in sorted(results, key=lambda r: (order.get(r["name"], len(order)), r["name"])):
        lines += _result(result)
    return "\n".join(lines).rstrip() + "\n"


def insert(text: str, result: dict[str, Any]) -> str:
    """Return a page whose block of this result's name holds the head of the result. ``InputError`` without a block."""
    begin, end = f"<!-- {result['name']} -->", "<!-- end -->"
    head = "\n".join(_content(result["sections"][0]))
    made, count = re.subn(rf"{begin}\n.*?{end}", lambda _: f"{begin}\n{head}{end}", text, count=1, flags=re.DOTALL)
    if not count:
        raise InputError(f"the page has no block from '{begin}' to '{end}'")
    return made


def read_all(folder: Path) -> list[dict[str, Any]]:
    """Read every artefact of a folder. Raises ``InputError`` when one is not an artefact."""
    return [load(path) for path in sorted(folder.glob("*.json"))]


def _result(result: dict[str, Any]) -> list[str]:
    name, sections = result["name"], result["sections"]
    lines = [f"## {result['title']}", "", f"File: [{name}.json](results/{name}.json).", ""]
    lines += _content(sections[0])
    left_out: list[str] = []
    for section in sections[1:]:
        if section["title"].startswith(SHOWN.get(name, ()) or ("\0",)):
            lines += [f"### {section['title']}", "", *_content(section)]
        elif misses := _misses(section):
            lines += [f"### {section['title']}", "", *misses]
        else:
            left_out.append(section["title"])
    if left_out:
        lines += [f"In the file alone: {'; '.join(left_out)}.", ""]
    return lines


def _content(section: dict[str, Any]) -> list[str]:
    return [line for block in section["content"] for line in _without_links(block_lines(block))]


def _misses(section: dict[str, Any]) -> list[str]:
    """Return the notes of a table of published figures, and its rows that are not met with the reason of each."""
    tables = [b for b in section["content"] if b.get("columns", [""])[-1] == "met" and "published" in b["columns"]]
    if not tables:
        return []
    lists = [item for b in section["content"] for item in b.get("list", [])]
    lines = [line for b in section["content"] if "note" in b and b["note"] != "Not met:" for line in block_lines(b)]
    rows = [row for table in tables for row in table["rows"] if row[-1] == MISSED]
    out: list[list[str]] = []
    for source, quantity, _, published, ours, unit, obtained, _ in rows:
        begin = f"{quantity} ({source}): {ours},"
        match = next((item for item in lists if item.startswith(begin)), "")
        out.append([source, quantity, published, ours, unit, match.partition("; ")[2] or obtained])
    notes = [item for item in lists if not any(item.startswith(f"{row[1]} ({row[0]}): ") for row in rows)]
    table = {"columns": ["source", "quantity, not met", "published", "ours", "unit", "why"], "right": [False] * 6}
    return [*lines, *(f"- {note}" for note in notes), "", *block_lines({**table, "rows": _joined(out)})]


def _joined(rows: list[list[str]]) -> list[list[str]]:
    """Return the rows with a reason that repeats the row above replaced by a ditto mark."""
    return [[*row[:5], '"' if n and row[5] == rows[n - 1][5] else row[5]] for n, row in enumerate(rows)]


def _without_links(lines: Sequence[str]) -> list[str]:
    """Return lines whose links to other pages are their text alone, since the artefacts outlive the pages."""
    return [re.sub(r"\[([^\]]+)\]\([\w-]+\.md\)", r"\1", line) for line in lines]


def main() -> int:
    """Exit status 2 on bad input."""
    parser = argparse.ArgumentParser(prog="python -m tools.research.results.page", description=__doc__)
    parser.add_argument("artefact", type=Path, nargs="?", help="print the full page of this result")
    parser.add_argument("--folder", type=Path, default=FOLDER, help="folder of the artefacts")
    parser.add_argument("--out", type=Path, metavar="FILE", help="write the page of all results there")
    parser.add_argument("--into", type=Path, metavar="PAGE", help="with an artefact: write its head into this page")
    a = parser.parse_args()
    try:
        if a.into:
            if a.artefact is None:
                raise InputError("--into needs the artefact whose head it writes")
            write_text_atomic(a.into, insert(a.into.read_text(encoding="utf-8"), load(a.artefact)))
            return 0
        text = to_markdown(load(a.artefact)) if a.artefact else page(read_all(a.folder))
        if a.out:
            write_text_atomic(a.out, text)
        else:
            print(text, end="")
    except InputError as error:
        parser.error(str(error))
    return 0


if __name__ == "__main__":
    sys.exit(main())
