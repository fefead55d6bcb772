"""Families of recordings with one concealed effect that is too weak for each: how many are named, and false alarms.

``python -m tools.research.prove.together --keep FOLDER --minutes 8`` goes on where it stopped. A family is one drawn
case whose effect has ``SEVERITY`` noise rms after a re-fit, cut into 5 to 20 recordings: each begins amid the course of
the plant, with a past that no recording holds. The first recording of each family is diagnosed alone beside it.
"""

from __future__ import annotations

import argparse
import itertools
import json
import tempfile
import time
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from tools.mismatch.engine.report import Report
from tools.mismatch.infer import diagnose
from tools.mismatch.recording import Part, Recording, Split
from tools.mismatch.recording_load import load
from tools.research.prove import disk, draw
from tools.research.prove.catalog import TABLE
from tools.research.prove.harness import read_rows
from tools.research.prove.nulls import clopper_pearson

SEVERITY = 1.0
"""Rms of the concealed effect after a re-fit of the base parameters, in noise rms."""
TWINS = ("piezo_stack", "mechanical_axis", "state_space", "accelerometer", "magnetometer")
EFFECTS = (
    "hysteresis", "backlash", "static_nonlinearity", "saturation", "dead_zone", "coulomb_friction", "cubic_stiffness",
    "first_order_lag", "resonance", "dead_time", "cross_axis_nonlinearity", "misalignment", "soft_iron",
)  # fmt: skip
"""Effects that every stretch of a record shows. What happens once would be in one recording of a family only."""
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


def run_one(seed: int, index: int, max_samples: int, *, null: bool) -> dict[str, Any]:
    """Draw, cut and diagnose one family; what was said of it, as a row."""
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
    if not null:
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
    """Counts with exact 95 % intervals (Clopper and Pearson 1934)."""
    drawn = [r for r in rows if r["drawn"]]
    some, none = [r for r in drawn if not r["null"]], [r for r in drawn if r["null"]]
    lines = [
        ("named together", sum(r["named"] for r in some), len(some)),
        ("named or in its group", sum(r["grouped"] for r in some), len(some)),
        ("one recording alone: named", sum(r["alone"]["named"] for r in some), len(some)),
        ("null: physics named", sum(bool(r["names"]) for r in none), len(none)),
        ("null: unexplained", sum(r["verdict"] == "unexplained" for r in none), len(none)),
        ("a change named (there was none)", sum(bool(r["changes"]) for r in drawn), len(drawn)),
    ]
    text: list[str] = []
    for label, k, n in lines:
        low, high = clopper_pearson(k, n) if n else (0.0, 1.0)
        text.append(f"{label:32} {k:3} of {n:3}   {100 * low:.0f} to {100 * high:.0f} %")
    seconds = sum(r["cpu_s"] for r in drawn)
    return "\n".join([*text, f"{len(rows) - len(drawn)} could not be drawn; {seconds:.0f} s of CPU"])


def main(arguments: Sequence[str] | None = None) -> None:
    """Run what is not done yet, families and nulls in turn, and print the table."""
    parser = argparse.ArgumentParser(description="Measure diagnosis of several recordings together.")
    parser.add_argument("--keep", type=Path, required=True, help="rows.jsonl there; a stopped run goes on")
    parser.add_argument("--families", type=int, default=10)
    parser.add_argument("--nulls", type=int, default=20)
    parser.add_argument("--seed", type=int, default=26)
    parser.add_argument("--samples", type=int, default=4000, help="most samples of a family")
    parser.add_argument("--minutes", type=float, default=float("inf"), help="begin no family after these")
    options = parser.parse_args(arguments)
    options.keep.mkdir(parents=True, exist_ok=True)
    file = options.keep / "rows.jsonl"
    rows = read_rows(file) if file.is_file() else []
    done = {(r["null"], r["index"]) for r in rows}
    ahead = [(k / options.families, False, k) for k in range(options.families)]
    ahead += [(k / options.nulls, True, k) for k in range(options.nulls)]
    began = time.monotonic()
    for _, null, index in sorted(ahead):
        if (null, index) in done:
            continue
        if time.monotonic() - began > 60 * options.minutes:
            break
        rows.append(run_one(options.seed, index, options.samples, null=null))
        with file.open("a") as out:
            out.write(json.dumps(rows[-1]) + "\n")
    print(table(rows))


if __name__ == "__main__":
    main()
