"""`python -m tools.research.prove.corpus_page OLD.json NEW.json`: docs/results/mismatch-engines.json from what
`micron mismatch prove --corpus ... --json` wrote for both engines on the same cases.
"""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from tools.mismatch.infer.constants import FILE
from tools.research.prove.corpus_table import APART, LINES, share_text
from tools.research.prove.exact import compare_paired, summarise
from tools.research.results.artefact import write_result

PAIRED = {
    "verdict_right": "verdict right", "set_right": "set of names right",
    "grouped_right": "... up to stated equivalences", "no_false_name": "no false name",
}  # fmt: skip


def read(path: Path) -> dict[str, Any]:
    """One run over a corpus. ValueError when the file is not one."""
    try:
        body = json.loads(path.read_text())
    except (OSError, json.JSONDecodeError) as error:
        raise ValueError(f"{path}: cannot be read ({error}); give what `prove --corpus --json` wrote") from error
    if not isinstance(body, dict) or "corpus" not in body or "rows" not in body:
        raise ValueError(f"{path}: not a run over a corpus; give what `prove --corpus --json` wrote")
    return body


def document(old: Mapping[str, Any], new: Mapping[str, Any], constants: Mapping[str, Any]) -> str:
    """The page. ValueError when the two runs are not of the same corpus and length of recordings."""
    for key in ("corpus", "max_samples"):
        if old[key] != new[key]:
            raise ValueError(f"the runs differ in {key}: {old[key]} and {new[key]}")
    both = {r["case"] for r in old["rows"]} & {r["case"] for r in new["rows"]}
    rows = [[r for r in run["rows"] if r["case"] in both] for run in (old, new)]
    a, b = (summarise(r) for r in rows)
    lines = [
        "# Two engines on the same cases",
        "",
        "Made by `python -m tools.research.prove.corpus_page` from runs of `micron mismatch prove --corpus"
        f" {old['corpus']} --json`; do not edit. How the new engine decides:"
        " [one score](mismatch-engine.md). Scores are exact; no figure is filtered out of the intervals."
        " Intervals of shares are Clopper-Pearson.",
        "",
        f"{len(both)} cases that both engines have, at most {old['max_samples']} samples each;"
        f" tool {new['revision'][:12]}, {new['date']}."
        + (" The corpus is for development: it was looked at." if old["corpus"] != "sealed" else ""),
        "",
        "| score | old | new |",
        "|---|---|---|",
    ]
    for key, text in LINES.items():
        cells = (f"{s[key][0]} of {s[key][1]} {share_text(*s[key])}".strip() for s in (a, b))
        lines.append(f"| {text} | {' | '.join(cells)} |")
    errors = (s["reliability"]["expected_calibration_error"] for s in (a, b))
    lines.append(
        "| expected calibration error of \"sure\" | "
        + " | ".join("" if e is None else f"{e:.3f}" for e in errors) + " |"
    )  # fmt: skip
    lines.append("| CPU, s | " + " | ".join(f"{s['cpu_s']['total']:.0f}" for s in (a, b)) + " |")
    lines += [
        "",
        "## The same cases, paired",
        "",
        "| score | both | old alone | new alone | neither |",
        "|---" * 5 + "|",
    ]
    paired = compare_paired(*rows)
    lines += [f"| {text} | " + " | ".join(map(str, paired[key])) + " |" for key, text in PAIRED.items()]
    lines += [
        "",
        "## How sure, and how often right",
        "",
        "| engine | stated | mean stated | right | names |",
        "|---" * 5 + "|",
    ]
    for name, s in (("old", a), ("new", b)):
        for low, high, stated, right, count in s["reliability"]["bins"]:
            lines.append(f"| {name} | {low:.2f} to {high:.2f} | {stated:.3f} | {right:.3f} | {count:.0f} |")
    lines += ["", "## By kind of twin (old, new)", "", "| twin | singles | pairs | grouped | unknown | null | CPU s |"]
    lines.append("|---" * 7 + "|")
    for kind, figures in a["by_twin_kind"].items():
        other = b["by_twin_kind"][kind]
        cells = [f"{figures[k][0]}, {other[k][0]} of {figures[k][1]}" if figures[k][1] else "" for k in APART]
        lines.append(
            f"| {kind} | {' | '.join(cells)} | {figures['cpu_s']['total']:.0f}, {other['cpu_s']['total']:.0f} |"
        )
    lines += ["", "## Where they differ or both are wrong", "", "| case | twin | true | old | new |", "|---" * 5 + "|"]
    for r, q in zip(*rows, strict=True):
        if not (r["set_right"] and q["set_right"] and not r["false_names"] and not q["false_names"]):
            true = " + ".join(r["true"]) or r["kind"]
            said = (f"{_mark(x)} {x['verdict']}: {' + '.join(x['said']) or 'none'}" for x in (r, q))
            lines.append(f"| {r['case']} | {r['twin']} | {true} (severity {r['severity']:g}) | {' | '.join(said)} |")
    return "\n".join([*lines, "", *_constants(constants), ""])


def _mark(row: Mapping[str, Any]) -> str:
    return "right," if row["set_right"] else "wrong,"


def _constants(body: Mapping[str, Any]) -> Sequence[str]:
    """The learned constants and where they come from."""
    about = body["provenance"]
    if not about.get("learned"):
        return ["The constants of the new engine were not learned yet."]
    figures = body["cross_validated"]
    sure = figures["sure"]
    error = sure["expected_calibration_error"]
    return [
        "## Constants of the new engine", "",
        f"Learned by `micron mismatch calibrate` on {about['cases']} cases (seeds {about['seeds'][0]} to"
        f" {about['seeds'][1]}, at most {about['max_samples']} samples, without {', '.join(about['without'])}),"
        f" answers `{about['corpus_sha256'][:16]}`, generator `{about['generator'][:16]}`.", "",
        "| constant | value |", "|---|---|",
        *(f"| {k} | {v:.4g} |" for k, v in body["constants"].items()), "",
        f"Cross-validated: {figures['exactly_right']:.0f} of {figures['cases']} cases exactly right"
        f" ({figures['with_the_start']:.0f} with the constants that learning began at); the search had fitted the"
        f" true set in {figures['true_set_was_searched']:.0f}. Mean log probability of the true set"
        f" {figures['mean_log_probability']:.2f}."
        + ("" if error is None else f" Map of \"sure\": {sure['names']} names of {sure['cases']} other cases, each with"
           f" the map of the rest, expected calibration error {error:.3f}."),
    ]  # fmt: skip


def main() -> int:
    """Exit 2 on bad input."""
    p = argparse.ArgumentParser(prog="python -m tools.research.prove.corpus_page", description=__doc__)
    p.add_argument("old", type=Path)
    p.add_argument("new", type=Path)
    p.add_argument("--out", type=Path, required=True, metavar="FILE", help="the result (FILE.json) or its page")
    a = p.parse_args()
    try:
        write_result(a.out, document(read(a.old), read(a.new), json.loads(FILE.read_text())))
    except (OSError, ValueError) as error:
        p.error(str(error))
    print(f"page: {a.out}", file=sys.stderr)
    return 0


if __name__ == "__main__":
    sys.exit(main())
