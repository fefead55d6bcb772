"""Families of recordings with one concealed effect that is too weak for each: how many are named, and false alarms.

``python -m tools.research.prove.together --keep FOLDER --minutes 8`` goes on where it stopped. A family is one drawn
case whose effect has ``SEVERITY`` noise rms after a re-fit, cut into 5 to 20 recordings: each begins amid the course of
the plant, with a past that no recording holds. With ``--alone`` the first recording of each is diagnosed alone, too.
"""

from __future__ import annotations

import argparse
import itertools
import json
import tempfile
import time
from collections import Counter
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from threadpoolctl import threadpool_limits

from tools.mismatch.engine.report import Report
from tools.mismatch.infer import diagnose
from tools.mismatch.recording import Part, Recording, Split
from tools.mismatch.recording_load import load
from tools.research.prove import disk, draw
from tools.research.prove.catalog import TABLE
from tools.research.prove.harness import read_rows
from tools.research.prove.nulls import clopper_pearson
from tools.research.results.artefact import write_result
from tools.research.stamp import revision_and_day

SEVERITY = 1.0
"""Rms of the concealed effect after a re-fit of the base parameters, in noise rms."""
TWINS = ("piezo_stack", "mechanical_axis", "state_space", "accelerometer", "magnetometer")
EFFECTS = (
    "hysteresis", "backlash", "static_nonlinearity", "saturation", "dead_zone", "coulomb_friction", "cubic_stiffness",
    "first_order_lag", "resonance", "dead_time", "cross_axis_nonlinearity", "misalignment", "soft_iron",
)  # fmt: skip
"""Effects that every stretch of a record shows. What happens once would be in one recording of a family only."""
GOALS = (0.9, 0)
"""Share of the families whose effect should be named, and of the null families that may name one."""
LEAST, MOST, USUAL = 5, 20, 400
"""Fewest and most recordings of a family, and the samples of each where the drawn case is neither short nor long."""


def family(recording: Recording, count: int) -> Recording:
    """Draw a recording cut into ``count`` parts of equal length that are diagnosed together."""
    edges = [int(e) for e in np.linspace(0, recording.n, count + 1)]
    parts = tuple(Part(f"{k + 1}", a, b) for k, (a, b) in enumerate(itertools.pairwise(edges)))
    return replace(recording, split=Split(), segments=tuple(edges[1:-1]), parts=parts)


def first_alone(recording: Recording) -> Recording:
    """The first recording of a family by itself."""
    stop = recording.parts[0].stop
    signals = {
        kind: {s: x[:stop] for s, x in getattr(recording, kind).items()} for kind in ("inputs", "outputs", "context")
    }
    return replace(recording, t=recording.t[:stop], segments=(), parts=(), **signals)


def plan_of(seed: int, index: int, *, null: bool) -> draw.Plan:
    """The plan of a family: twins in turn, an effect at random; of three nulls one needs recalibration."""
    rng = np.random.default_rng([seed, index, int(null)])
    twin = TWINS[index % len(TWINS)]
    if null:
        return draw.Plan("recalibrate" if index % 3 == 2 else "agrees", twin, (), 4.0)
    return draw.Plan("single", twin, (str(rng.choice([e for e in EFFECTS if e in TABLE[twin]])),), SEVERITY)


def run_one(seed: int, index: int, max_samples: int, *, null: bool, alone: bool = False) -> dict[str, Any]:
    """Draw, cut and diagnose one family, and its first recording ``alone``; the outcome as a row.

    Linear algebra runs on one thread.
    """
    with threadpool_limits(1):
        found = _run_one(seed, index, max_samples, null=null, alone=alone)
    return {"seed": seed, "revision": revision_and_day(), **found}


def _run_one(seed: int, index: int, max_samples: int, *, null: bool, alone: bool) -> dict[str, Any]:
    plan = plan_of(seed, index, null=null)
    row: dict[str, Any] = {"index": index, "null": null, "twin": plan.twin, "effect": ", ".join(plan.effects)}
    try:
        case = draw.make([seed, index, int(null)], plan, max_samples)
    except draw.NotVisible:
        return {**row, "drawn": False}
    with tempfile.TemporaryDirectory(prefix="micron-family-") as folder:
        rng = np.random.default_rng([seed, index, 9])
        recording = load(disk.write(case, Path(folder) / "case", "family", rng))
    count = int(np.clip(recording.n // USUAL, LEAST, MOST))
    joined = family(recording, count)
    began = time.process_time()
    report = diagnose(joined, jobs=1)
    row |= {"drawn": True, "recordings": count, "samples": recording.n, **_answers(report, plan.effects)}
    row["cpu_s"] = round(time.process_time() - began, 1)
    if alone and not null:
        row["alone"] = _answers(diagnose(first_alone(joined), jobs=1), plan.effects)
    return row


def _answers(report: Report, effects: Sequence[str]) -> dict[str, Any]:
    names = [p.name for p in report.physics] if report.verdict == "missing_physics" else []
    alike = {n for e in report.equivalent if set(e.names) & set(names) for n in e.names}
    together = report.together
    return {
        "verdict": report.verdict,
        "names": names,
        "named": bool(effects) and set(effects) <= set(names),
        "grouped": bool(effects) and set(effects) <= {*names, *alike},
        "p_value": together.p_value if together else None,
        "changes": [f"{c.parameter}: {c.condition}" for c in together.changes] if together else [],
    }


def table(rows: Sequence[dict[str, Any]]) -> str:
    """Return counts with exact 95 % intervals (Clopper and Pearson 1934) beside their goals."""
    drawn = [r for r in rows if r["drawn"]]
    some, none = [r for r in drawn if not r["null"]], [r for r in drawn if r["null"]]
    lines = [
        ("effect named, recordings together", f"{100 * GOALS[0]:.0f} %", sum(r["named"] for r in some), len(some)),
        ("effect named, or in the group of a name", "-", sum(r["grouped"] for r in some), len(some)),
        ("a name besides the effect or its group", "-", sum(_has_false_name(r) for r in some), len(some)),
        ("null families with a name", str(GOALS[1]), sum(bool(r["names"]) for r in none), len(none)),
        ("null families that are unexplained", "-", sum(r["verdict"] == "unexplained" for r in none), len(none)),
        ("families with a change between recordings named", "0", sum(bool(r["changes"]) for r in drawn), len(drawn)),
    ]
    alone = [r["alone"]["named"] for r in some if "alone" in r]
    if alone:
        lines.insert(3, ("effect named, first recording alone", "-", sum(alone), len(alone)))
    text = ["| figure | goal | measured | 95 % interval |", "|---|---|---|---|"]
    for label, goal, k, n in lines:
        low, high = clopper_pearson(k, n) if n else (0.0, 1.0)
        text.append(f"| {label} | {goal} | {k} of {n} | {100 * low:.0f} to {100 * high:.0f} % |")
    return "\n".join(text)


def _has_false_name(row: dict[str, Any]) -> bool:
    expected = 1 if row["grouped"] else 0
    return len(set(row["names"])) > expected


def not_run(rows: Sequence[dict[str, Any]], families: int, nulls: int) -> str:
    """Return the number of families of each twin that are not in ``rows``, in words; "none" if all are."""
    done = {(r["null"], r["index"]) for r in rows}
    twins = [plan_of(0, k, null=n).twin for n, count in ((False, families), (True, nulls)) for k in range(count)]
    left = Counter(twins)
    left.subtract(plan_of(0, k, null=n).twin for n, k in done)
    return ", ".join(f"{v} of a {twin.replace('_', ' ')}" for twin, v in left.items() if v > 0) or "none"


def page(rows: Sequence[dict[str, Any]], samples: int, families: int, nulls: int, remark: str = "") -> str:
    """Return the result's page; ``families`` and ``nulls`` are the numbers that were asked for.

    ``remark`` is what the rows do not know: earlier draws, and what was changed since.
    """
    drawn, seed = [r for r in rows if r["drawn"]], rows[0]["seed"]
    revisions = "; ".join(dict.fromkeys(r["revision"] for r in rows))
    missed = [
        f"- {r['effect'].replace('_', ' ')} of a {r['twin'].replace('_', ' ')}, {r['recordings']} recordings: "
        f"{r['verdict']}{': ' if r['names'] else ''}{', '.join(r['names']).replace('_', ' ')}"
        f"{', with the effect in its group' if r['grouped'] else ''}"
        for r in drawn
        if not r["null"] and not r["named"]
    ]
    false = [f"- null of a {r['twin']}: {', '.join(r['names'])}" for r in drawn if r["null"] and r["names"]]
    return f"""# Many recordings at once

Made by `python -m tools.research.prove.together --seed {seed} --families {families} --nulls {nulls} --keep FOLDER
--out docs/results/together.json`, revision {revisions}; do not edit.

A family is one drawn case of at most {samples} samples whose effect has {SEVERITY:g} noise rms after a re-fit, cut into
{LEAST} to {MOST} recordings that are diagnosed together. Null families have no effect; every third of them needs
recalibration.

{table(rows)}

- {len(rows) - len(drawn)} of {len(rows)} families could not be drawn.
- Not run of {families} families and {nulls} nulls, for lack of processor time: {not_run(rows, families, nulls)}.
- CPU: {sum(r["cpu_s"] for r in drawn):.0f} s.
{"- " + remark if remark else ""}

## Not named

{chr(10).join([*missed, *false]) or "- none"}
"""


def main(arguments: Sequence[str] | None = None) -> None:
    """Run what is not done yet, families and nulls in turn, and print the table."""
    parser = argparse.ArgumentParser(description="Measure diagnosis of several recordings together.")
    parser.add_argument("--keep", type=Path, required=True, help="rows.jsonl there; a stopped run goes on")
    parser.add_argument("--families", type=int, default=10)
    parser.add_argument("--nulls", type=int, default=20)
    parser.add_argument("--seed", type=int, default=26)
    parser.add_argument("--samples", type=int, default=4000, help="most samples of a family")
    parser.add_argument("--minutes", type=float, default=float("inf"), help="begin no family after these")
    parser.add_argument("--alone", action="store_true", help="diagnose the first recording of each family alone, too")
    parser.add_argument("--out", type=Path, metavar="FILE", help="write the result there (.json or .md)")
    parser.add_argument("--remark", default="", help="what the page says besides: earlier draws, later changes")
    options = parser.parse_args(arguments)
    options.keep.mkdir(parents=True, exist_ok=True)
    file = options.keep / "rows.jsonl"
    rows = [r for r in read_rows(file) if r["seed"] == options.seed] if file.is_file() else []
    done = {(r["null"], r["index"]) for r in rows}
    ahead = [(k / options.families, False, k) for k in range(options.families)]
    ahead += [(k / options.nulls, True, k) for k in range(options.nulls)]
    began = time.monotonic()
    for _, null, index in sorted(ahead):
        if (null, index) in done:
            continue
        if time.monotonic() - began > 60 * options.minutes:
            break
        rows.append(run_one(options.seed, index, options.samples, null=null, alone=options.alone))
        with file.open("a") as out:
            out.write(json.dumps(rows[-1]) + "\n")
    if not rows:
        return
    print(table(rows))
    if options.out is not None:
        write_result(options.out, page(rows, options.samples, options.families, options.nulls, options.remark))


if __name__ == "__main__":
    main()
