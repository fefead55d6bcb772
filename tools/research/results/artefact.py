"""A result as JSON: title, provenance, and sections of notes, lists and tables. Lossless both ways with its page.

Cells are the text that the command printed, because digits and units there are part of the statement.
"""

from __future__ import annotations

import json
import re
from collections.abc import Iterator
from itertools import pairwise
from pathlib import Path
from typing import Any

from tools.errors import InputError
from tools.output import write_text_atomic

FORMAT = 1
REVISION = re.compile(r"\b[0-9a-f]{40}(?:-dirty)?\b")
SHORT_REVISION = re.compile(r"[Tt]ool ([0-9a-f]{12})\b")
DAY = re.compile(r"\b20\d\d-\d\d-\d\d\b")
SEED = re.compile(r"(?:--seed |Seed |, seed )(\d{4,})")
COMMAND = re.compile(r"(?<!`)`((?:micron|python -m) [^`]+)`")
CELL = re.compile(r"(?<!\\)\|")
RULE = re.compile(r"^\|[ :|-]+\|$")


def from_markdown(name: str, text: str) -> dict[str, Any]:
    """Return the artefact of a page.

    Args:
        name: the artefact's name, the stem of its file.
        text: the page: one ``#`` title, then paragraphs, lists, tables, comments and deeper headings.

    Raises:
        InputError: the text does not begin with a title.
    """
    if not text.startswith("# "):
        raise InputError(f"{name}: a result's page begins with '# ' and its title")
    sections: list[dict[str, Any]] = []
    for level, title, lines in _sections(text):
        sections.append({"level": level, "title": title, "content": list(_blocks(lines))})
    head = sections[0]
    for previous, section in pairwise(sections):
        if previous["content"] and previous["content"][-1].get("comment", "end") != "end":
            section["key"] = previous["content"].pop()["comment"]
    for section in sections:
        section["content"] = [b for b in section["content"] if b.get("comment") != "end"]
    commands = list(dict.fromkeys(" ".join(c.split()) for c in COMMAND.findall(text)))
    tools = [row[-1] for row in _rows(sections, "set") if re.fullmatch("[0-9a-f]{8}", row[-1])]
    seeds = [int(s) for s in SEED.findall(text)]
    seeds += [int(row[0]) for row in _rows(sections, "seed") if row[0].isdecimal()]
    return {
        "format": FORMAT,
        "name": name,
        "title": head["title"],
        "provenance": {
            "commands": [c for c in commands if "--out" in c or "--json" in c or c.startswith("python")],
            "revisions": list(dict.fromkeys([*REVISION.findall(text), *SHORT_REVISION.findall(text), *tools])),
            "days": sorted(set(DAY.findall(text))),
            "seeds": list(dict.fromkeys(seeds)),
        },
        "sections": sections,
    }


def to_markdown(result: dict[str, Any]) -> str:
    """Return the page of an artefact, from which ``from_markdown`` makes the artefact again."""
    lines: list[str] = []
    for section in result["sections"]:
        key = section.get("key")
        lines += [f"<!-- {key} -->"] if key else []
        lines += [f"{'#' * section['level']} {section['title']}", ""]
        lines += section_lines(section)
        lines += ["<!-- end -->", ""] if key else []
    return "\n".join(lines).rstrip() + "\n"


def section_lines(section: dict[str, Any]) -> list[str]:
    """Return the Markdown lines of a section without its heading."""
    return [line for block in section["content"] for line in block_lines(block)]


def block_lines(block: dict[str, Any]) -> list[str]:
    """Return the Markdown lines of one block (note, list, table or comment), with an empty line after it."""
    if "note" in block:
        return [block["note"], ""]
    if "list" in block:
        return [*(f"- {item}" for item in block["list"]), ""]
    if "columns" in block:
        rules = ["---:" if right else "---" for right in block["right"]]
        return [_row(block["columns"]), f"|{'|'.join(rules)}|", *map(_row, block["rows"]), ""]
    return [f"<!-- {block['comment']} -->", ""]


def write_result(path: Path, text: str) -> None:
    """Write a result's page: as an artefact when ``path`` ends in .json, else as Markdown. Raises ``OutputError``."""
    if path.suffix == ".json":
        text = json.dumps(from_markdown(path.stem, text), indent=1, ensure_ascii=False) + "\n"
    write_text_atomic(path, text)


def read_page(path: Path) -> str:
    """Return the page of an artefact or of a Markdown file. Raises ``InputError`` for a JSON file of another kind."""
    text = path.read_text(encoding="utf-8")
    if path.suffix != ".json":
        return text
    return to_markdown(load(path))


def load(path: Path) -> dict[str, Any]:
    """Read an artefact. Raises ``InputError`` when the file is not one."""
    try:
        result = json.loads(path.read_text(encoding="utf-8"))
        known = result["format"] == FORMAT and isinstance(result["sections"], list)
    except (ValueError, KeyError, TypeError, OSError) as error:
        raise InputError(f"{path}: no result: {error}") from error
    if not known:
        raise InputError(f"{path}: no result of format {FORMAT}")
    return result


def _sections(text: str) -> Iterator[tuple[int, str, list[str]]]:
    parts = re.split(r"^(#{1,6}) (.+)$", text, flags=re.MULTILINE)
    for i in range(1, len(parts), 3):
        yield len(parts[i]), parts[i + 1].strip(), parts[i + 2].splitlines()


def _blocks(lines: list[str]) -> Iterator[dict[str, Any]]:
    chunk: list[str] = []
    for line in [*lines, ""]:
        comment = re.fullmatch(r"<!-- (.+) -->", line.strip())
        same = bool(chunk) and chunk[0].startswith("|") == line.startswith("|")
        starts_list = line.startswith("- ") and bool(chunk) and not chunk[0].startswith("- ")
        if chunk and (not line.strip() or comment or not same or starts_list):
            yield _block(chunk)
            chunk = []
        if comment:
            yield {"comment": comment[1]}
        elif line.strip():
            chunk.append(line)


def _block(chunk: list[str]) -> dict[str, Any]:
    if chunk[0].startswith("|") and len(chunk) > 1 and RULE.match(chunk[1]):
        right = [cell.strip().endswith(":") for cell in chunk[1].strip("|").split("|")]
        return {"columns": _cells(chunk[0]), "right": right, "rows": [_cells(line) for line in chunk[2:]]}
    if chunk[0].startswith("- "):
        items = re.split(r"^- ", "\n".join(chunk), flags=re.MULTILINE)[1:]
        return {"list": [" ".join(item.split()) for item in items]}
    return {"note": " ".join(" ".join(chunk).split())}


def _cells(line: str) -> list[str]:
    return [cell.strip() for cell in CELL.split(line.strip())[1:-1]]


def _row(cells: list[str]) -> str:
    return f"| {' | '.join(cells)} |"


def _rows(sections: list[dict[str, Any]], first_column: str) -> Iterator[list[str]]:
    for section in sections:
        for block in section["content"]:
            if block.get("columns", [""])[0] == first_column:
                yield from block["rows"]
