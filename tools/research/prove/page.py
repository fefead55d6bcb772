"""``python -m tools.research.prove.page A.json --out FILE`` makes docs/results/mismatch-proof.json of proofs."""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from tools.research.prove.nulls import clopper_pearson
from tools.research.prove.score import summary
from tools.research.prove.table import LINES, failures
from tools.research.results.artefact import write_result

SEVERITIES = ("2", "4", "10", "30")


def read(path: Path) -> dict[str, Any]:
    """Read a proof. Raises ValueError when the file is not one."""
    try:
        body = json.loads(path.read_text())
    except (OSError, json.JSONDecodeError) as error:
        raise ValueError(f"{path}: cannot be read ({error}); give what `prove --json` wrote") from error
    if not isinstance(body, dict) or "cases" not in body or "answers_sha256" not in body:
        raise ValueError(f"{path}: not a proof; give what `prove --json` wrote")
    return body


def _share(got: int, of: int) -> str:
    low, high = clopper_pearson(got, of)
    return f"{100 * got / of:.0f} % ({100 * low:.0f} to {100 * high:.0f})"


def _count(p: Mapping[str, Any]) -> str:
    """Return how many cases, and of how many when the run was stopped before its end."""
    n = len(p["cases"])
    skipped = p.get("left_out", [])
    without = f" without {', '.join(skipped)}" if skipped else ""
    return f"the first {n + len(skipped)} of {p['asked']}{without}" if p.get("asked", n) != n else str(n)


def _totals(s: Mapping[str, Any]) -> list[str]:
    lines = ["| measure | count | share (95 % interval) | goal |", "|---|---|---|---|"]
    for key, text, goal, more in LINES:
        got, of = s[key]
        target = "" if goal is None else f"{'at least' if more else 'at most'} {100 * goal:.0f} %"
        lines.append(f"| {text} | {got} of {of} | {_share(got, of) if of else ''} | {target} |")
    return lines


def _classes(s: Mapping[str, Any]) -> list[str]:
    lines = [f"| effect | {' | '.join(SEVERITIES)} | said instead |", "|---" * (len(SEVERITIES) + 2) + "|"]
    for name in sorted(s["by_class"]):
        cells = s["by_class"][name]
        other = sorted((k, v) for k, v in s["confusion"][name].items() if k != name)
        counts = " | ".join(f"{cells[k][0]}/{cells[k][1]}" if k in cells else "" for k in SEVERITIES)
        lines.append(f"| {name} | {counts} | {', '.join(f'{k} {v}' for k, v in other)} |")
    return lines


def document(proofs: Sequence[Mapping[str, Any]]) -> str:
    """The text of the page: all cases of all proofs together, every one that went wrong by name."""
    rows = [row for p in proofs for row in p["cases"]]
    s = summary(rows)
    revisions = sorted({str(p.get("revision", "unknown"))[:12] for p in proofs})
    dates = sorted({str(p["date"]) for p in proofs})
    weak = ", ".join(f"{k} {got} of {of}" for k, (got, of) in sorted(s["weak_classes"].items())) or "none"
    lines = [
        "# The blind proof of the mismatch tool",
        "",
        "Made by `python -m tools.research.prove.page` from runs of `micron mismatch prove --json`; do not edit. The "
        "generator shares no code with the effects and has forms of its own. Seeds were drawn after the tool was "
        "frozen; the hash of the answers was printed before the first diagnosis. Intervals are Clopper-Pearson.",
        "",
        f"{len(rows)} cases; tool {', '.join(revisions)}; {', '.join(dates)}. CPU of the "
        f"diagnoses {s['cpu_s_total']:.0f} s: median {s['cpu_s_median'] or 0:.1f} s a case, longest "
        f"{s['cpu_s_max'] or 0:.1f} s.",
        "",
        "| seed | cases | samples at most | sha256 of the answers |",
        "|---|---|---|---|",
        *(f"| {p['seed']} | {_count(p)} | {p['max_samples']} | `{p['answers_sha256']}` |" for p in proofs),
        "",
        *_totals(s),
        "",
        f"Weak classes (named first, of all severities): {weak}.",
        "",
        "## By class and severity (effect rms over noise rms)",
        "",
        *_classes(s),
        "",
        "## What went wrong",
        "",
        *(f"- {line}" for line in failures(rows)),
        "",
    ]
    return "\n".join(lines)


def main() -> int:
    """Exit 2 on bad input."""
    p = argparse.ArgumentParser(prog="python -m tools.research.prove.page", description=__doc__)
    p.add_argument("proofs", type=Path, nargs="+", metavar="PROOF.json", help="what prove --json wrote")
    p.add_argument("--out", type=Path, required=True, metavar="FILE", help="the result (FILE.json) or its page")
    a = p.parse_args()
    try:
        text = document([read(path) for path in a.proofs])
        write_result(a.out, text)
    except (ValueError, OSError) as error:
        p.error(str(error))
    print(f"page: {a.out}", file=sys.stderr)
    return 0


if __name__ == "__main__":
    sys.exit(main())
