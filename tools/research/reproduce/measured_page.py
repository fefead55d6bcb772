"""docs/results/mismatch-measured.json, made of what ``micron reproduce measured`` found."""

from __future__ import annotations

import re
import time
from collections.abc import Sequence

from tools.research.reproduce.measured_rows import Scored, explained, rows_of
from tools.research.reproduce.measured_sets import SETS

_HEAD = (
    "Made by `micron reproduce measured --out docs/results/mismatch-measured.json`; do not edit. Each set starts from "
    "the twin that its own papers give. The engine sees the fit part alone and splits that by itself; the "
    "corrected twin is written as a file, and the file is run freely over the official test once, after all "
    "decisions (the accelerometer package: held-out blocks of its test sweep, since the lag differs from run to "
    "run). The rules of the engine were made by people who knew these recordings: they are development data; smooth "
    "inputs, the lean of a hysteretic loop and the steps it is integrated with, the diode between two filters, the "
    "intervals of weights that cancel, the loss of a hardening spring and a sensor without a sign were added after a "
    "look at the fit parts of Silverbox, Bouc-Wen, Wiener-Hammerstein, the coupled drives and the piezo stage; of the "
    "test, the figures of earlier revisions were known. The levels of all tanks at once, the starts in place of linear "
    "terms and the one sense of every loop were added after a look at the fit parts of the tanks and the piezo stage; "
    "the search by pairs, steps that follow a bound, the rest that a folded sensor begins at, its power and the offset "
    "of a drive that settles after a look at the fit parts of the tanks, the coupled drives and EMPS. "
    "The grader of the piezo stage was changed after a miss (2026-11-25; 1.17 um before; 1.21 um by the old grader "
    "after the change): its residual is scored after "
    "the first second and less its mean, as the published figures are; between its two runs the sensor's zero moved by "
    "0.87 um. A row is "
    "of the revision in its last column. The recordings are "
    "not part of the repository."
)


def document(found: Sequence[Scored], before: str = "") -> str:
    """The text of the page; sets that were not run are named. ``before``: an older page, whose rows and sections stand
    for the sets that are not in ``found``.
    """
    new = {f.name: f for f in found}
    rows, sections = parts_of(before)
    rows |= {f.name: _row(f) for f in found}
    sections |= {_SET[f.name].title: _section(f) for f in found}
    listed = [s for s in SETS if s.name in rows]
    absent = [s.name for s in SETS if s.name not in rows]
    met = [cells[8] for cells in (rows[s.name] for s in listed) if cells[8]]
    return "\n".join(
        [
            "# The mismatch tool on measured recordings",
            "",
            _HEAD,
            "",
            f"{time.strftime('%Y-%m-%d', time.gmtime())}; {met.count('yes')} of {len(met)} goals are met. CPU seconds"
            " are those of the diagnosis, in one process on a shared machine.",
            "",
            *([f"Not run for this page: {', '.join(absent)}.", ""] if absent else []),
            *([f"Run anew for this page: {', '.join(new)}.", ""] if len(new) < len(listed) else []),
            "| set | unit | as given | re-fitted | with physics | noise (tool's) | published | goal | met |"
            " what it said | CPU s | tool |",
            "|---|---|---|---|---|---|---|---|---|---|---|---|",
            *(f"| {' | '.join(rows[s.name])} |" for s in listed),
            "",
            *(line for s in listed for line in sections[s.title]),
        ]
    )


_SET = {s.name: s for s in SETS}


def parts_of(page: str) -> tuple[dict[str, list[str]], dict[str, list[str]]]:
    """Cells of the table by set, and lines of the sections by title, of a page that ``document`` made."""
    head, *rest = re.split(r"^## (.+)$", page, flags=re.MULTILINE)
    cells = [[c.strip() for c in line.strip("| ").split(" | ")] for line in head.splitlines() if line.startswith("| ")]
    pairs = zip(rest[::2], rest[1::2], strict=True)
    sections = {title: [f"## {title}", "", *text.strip().splitlines(), ""] for title, text in pairs}
    return {c[0]: c for c in cells if c[0] in _SET}, sections


def _row(f: Scored) -> list[str]:
    s = _SET[f.name]
    goal = next((row for row in rows_of(f) if row.source.startswith("goal")), None)
    published = "; ".join(f"{p.figure:g} ({p.what})" for p in s.published) or "none"
    verdict = f"{f.verdict}: {', '.join(f.named)}" if f.named else f.verdict
    return [
        f.name, s.unit, *(_figure(v) for v in (f.given, f.refitted, f.corrected, f.floor)), published,
        "" if goal is None else f"{goal.published:.3g}", "" if goal is None else "yes" if goal.meets else "no",
        verdict, f"{f.cpu_s:.0f}", f.revision[:8],
    ]  # fmt: skip


def _section(f: Scored) -> list[str]:
    s = _SET[f.name]
    location = f.report.get("location") or {}
    same = [", ".join(g["names"]) for g in f.report.get("equivalent") or []]
    lines = [f"## {s.title}", "", f"What its authors know: {s.known}", ""]
    if f.error:
        return [*lines, f"The engine failed: {f.error}", ""]
    lines += [
        f"What the tool said of the fit part: {f.report.get('summary', '')} Stage {location.get('stage') or '-'};"
        f" {location.get('regime') or '-'}.",
        "",
        f"{explained(f)[0].upper()}{explained(f)[1:]}.",
        "",
    ]
    for p in f.report.get("physics", ()):
        values = ", ".join(
            f"{n} {v['value']:.4g} ({v['ci95'][0]:.4g} to {v['ci95'][1]:.4g}) {v['unit']}"
            for n, v in p["parameters"].items()
            if None not in (v["value"], *v["ci95"])
        )
        lines.append(f"- {p['name']} ({p['stage']}, sure {100 * p['confidence']:.0f} %): {values or '-'}")
    lines += [""] if f.named else []
    if same:
        lines += [f"It cannot tell apart here: {'; '.join(same)}.", ""]
    return lines


def _figure(value: float | None) -> str:
    return "" if value is None else f"{value:.3g}"
