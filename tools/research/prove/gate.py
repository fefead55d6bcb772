"""`python -m tools.research.prove.gate --keep FOLDER`: both engines on the sealed corpus, case by case, and the gate
that the new one has to pass before the old one is deleted.

Rows are kept in FOLDER; the same command at the same commit goes on where it stopped. A case counts when both engines
have it. The first seed follows from the commit, so a change of the code draws other cases.
"""

from __future__ import annotations

import argparse
import json
import sys
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from tools.mismatch.engines import Engine
from tools.research.prove.corpus_table import share_text
from tools.research.prove.exact import compare_paired, summarise
from tools.research.prove.harness import Run, read_rows, run_corpus
from tools.research.results.artefact import write_result

CASES, SAMPLES = 300, 8000
"""Sealed cases that the gate asks for, and most samples of each."""
ENGINES: tuple[Engine, Engine] = ("old", "new")


@dataclass(frozen=True)
class Criterion:
    """One line of the gate: ``shown`` per engine (old, new), and whether the new one ``passes`` (None: unknown)."""

    text: str
    shown: tuple[str, str]
    passes: bool | None


def criteria(rows: Sequence[Sequence[Mapping[str, Any]]]) -> list[Criterion]:
    """The gate on paired rows (old, new)."""
    old, new = (summarise(r) for r in rows)
    _, old_alone, new_alone, _ = compare_paired(*rows)["set_right"]

    def share(key: str, is_met: Callable[[float], bool], text: str) -> Criterion:
        got, of = new[key]
        shown = (_count(old[key]), _count(new[key]))
        return Criterion(text, shown, is_met(got / of) if of else None)

    wrong = [s["wrong_not_flagged"][0] for s in (old, new)]
    errors = [s["reliability"]["expected_calibration_error"] for s in (old, new)]
    cpu = [float(s["cpu_s"]["total"]) for s in (old, new)]
    return [
        Criterion(
            "sets right that the other engine has wrong: not fewer", (f"{old_alone}", f"{new_alone}"),
            new_alone >= old_alone,
        ),
        Criterion(
            "wrong sets without 'unexplained': at most half", (_count(old["wrong_not_flagged"]),
            _count(new["wrong_not_flagged"])), 2 * wrong[1] <= wrong[0],
        ),
        share("extra_names", lambda v: v <= 0.05, "reports with a name too many: at most 5 %"),
        share("set_right_pair", lambda v: v >= 0.75, "pairs right: at least 75 %"),
        share("intervals_hold", lambda v: 0.92 <= v <= 0.98, "95 % intervals that hold: 92 to 98 %"),
        Criterion(
            'expected calibration error of "sure": at most 0.05',
            (_figure(errors[0]), _figure(errors[1])),
            None if errors[1] is None else errors[1] <= 0.05,
        ),
        share("false_names_under_null", lambda v: v == 0.0, "false names where nothing is missing: none"),
        Criterion(
            "CPU: at most 1.5 times", (f"{cpu[0]:.0f} s", f"{cpu[1]:.0f} s"), cpu[1] <= 1.5 * cpu[0] if cpu[0] else None
        ),
    ]  # fmt: skip


def _figure(value: float | None) -> str:
    return "" if value is None else f"{value:.3f}"


def _count(of: Sequence[int]) -> str:
    return f"{of[0]} of {of[1]} {share_text(*of)}".strip()


def paired(folder: Path, samples: int) -> tuple[list[dict[str, Any]], list[dict[str, Any]]]:
    """Rows (old, new) of the cases that both engines have, of the draw that was last begun."""
    found = [read_rows(folder / "rows" / f"sealed-{samples}-{e}.jsonl") for e in ENGINES]
    starts = [r["digest"].rpartition("-")[2] for rows in found for r in rows[-1:]]
    last = [{r["case"]: r for r in rows if r["digest"].rpartition("-")[2] == starts[-1]} for rows in found]
    both = [c for c in last[0] if c in last[1] and not last[0][c].get("left_out")]
    return [last[0][c] for c in both], [last[1][c] for c in both]


def document(rows: Sequence[Sequence[Mapping[str, Any]]], samples: int, revision: str, draws: int) -> str:
    """The page of the gate."""
    n = len(rows[0])
    verdict = {True: "yes", False: "no", None: ""}
    table = [f"| {c.text} | {c.shown[0]} | {c.shown[1]} | {verdict[c.passes]} |" for c in criteria(rows)]
    more = "" if n >= CASES else f" The gate asks for {CASES}: these figures are partial."
    pairs = compare_paired(*rows)
    names = {"verdict_right": "verdict right", "set_right": "set of names right", "no_false_name": "no false name"}
    return "\n".join(
        [
            "# The gate of the new engine", "",
            f"Made by `python -m tools.research.prove.gate`; do not edit. {n} sealed cases of at most {samples}"
            f" samples, which nobody has looked at; tool {revision[:12]}; the corpus was drawn for {draws}"
            f" commits.{more}", "",
            "| criterion | old | new | met |", "|---|---|---|---|", *table, "",
            "## The same cases, paired", "",
            "| score | both | old alone | new alone | neither |", "|---|---|---|---|---|",
            *(f"| {text} | {' | '.join(map(str, pairs[key]))} |" for key, text in names.items()), "",
        ]
    )  # fmt: skip


def main(arguments: Sequence[str] | None = None) -> int:
    """Exit 0 when the gate is passed, 1 when it is not, 3 while cases are to be done, and 2 on bad input."""
    p = argparse.ArgumentParser(prog="python -m tools.research.prove.gate", description=__doc__)
    p.add_argument("--keep", type=Path, required=True, metavar="FOLDER", help="rows of both engines")
    p.add_argument("--cases", type=int, default=CASES, help="sealed cases")
    p.add_argument("--samples", type=int, default=SAMPLES, help="most samples of a case")
    p.add_argument("--minutes", type=float, default=float("inf"), help="begin no case after these")
    p.add_argument("--out", type=Path, metavar="FILE", help="the result (FILE.json) or its page (FILE.md)")
    a = p.parse_args(arguments)
    until = time.monotonic() + 60.0 * a.minutes
    done = 0
    try:
        for number in range(a.cases):
            if time.monotonic() > until:
                break
            for engine in ENGINES:
                run_corpus(Run("sealed", engine, 1, a.samples, first=number), a.keep, progress=_told)
            done += 1
        rows = paired(a.keep, a.samples)
        draws = read_rows(a.keep / "sealed-draws.jsonl")
        if a.out is not None and rows[0]:
            revision = str(draws[-1]["revision"])
            write_result(a.out, document(rows, a.samples, revision, len({d["revision"] for d in draws})))
    except (OSError, ValueError, json.JSONDecodeError) as error:
        p.error(str(error))
    lines = criteria(rows) if rows[0] else []
    for c in lines:
        print(f"{ {True: 'met', False: 'not met', None: 'open'}[c.passes]:8}{c.text}: {c.shown[0]} (old), {c.shown[1]}")
    if done < a.cases:
        print(f"{a.cases - done} of {a.cases} cases are still to be done; run the same command again", file=sys.stderr)
        return 3
    return 0 if all(c.passes for c in lines) else 1


def _told(text: str) -> None:
    print(text, file=sys.stderr)


if __name__ == "__main__":
    sys.exit(main())
