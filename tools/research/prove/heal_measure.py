"""Benches with a concealed change: the tip error before and after ``micron mismatch heal``, beside the physics known.

``python -m tools.research.prove.heal_measure --keep FOLDER --seed 2613`` goes on where it stopped. The seed draws the
size of each change, the noise of all experiments and the hands of the runs that judge, which are none of those that
heal. Known is the changed bench with the firmware told of the change where a number tells it (``Change.told``), else
the unchanged bench, whose calibration was made for it: the best that a heal can reach.
"""

from __future__ import annotations

import argparse
import hashlib
import json
import re
import time
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from hal.bench import load_bench
from tools.emulate.shipped import bench_file
from tools.heal.figures import BANDS, LEVEL, WHOLE, TipError, rises, tip_error
from tools.heal.heal import heal
from tools.heal.parts import PARTS, Lab
from tools.output import write_text_atomic
from tools.research.prove.harness import read_rows
from tools.research.results.artefact import write_result
from tools.research.stamp import revision_and_day


@dataclass(frozen=True)
class Change:
    """``emulation`` is the table that the healer does not read, with ``{x}`` for the drawn size, ``nominal`` plus
    ``span`` times 0.6 to 1.4. ``told`` (pattern, replacement with ``{x}``) tells the firmware of it.
    """

    emulation: str
    nominal: float = 0.0
    span: float = 0.0
    told: tuple[str, str] | None = None


CHANGES = {
    "none": Change(""),
    "hysteresis of the stacks": Change("[emulation.stack]\nslip_sum = {x:.4g}", 0.52, 0.15),
    "amplifier's gain follows temperature": Change(
        "[emulation.amplifier]\ngain_per_K = {x:.4g}\n[emulation.environment]\nambient_C = 35.0", 0.0, 0.006
    ),
    "accelerometers turned by a degree": Change("[emulation.sensors]\nmisalignment_deg = {x:.4g}", 0.5, 1.0),
    "delay in the DAQ": Change(
        "[emulation.daq]\ndelay_ms = {x:.4g}", 0.0, 3.0, (r"^loop_delay_s = 0.0017", "loop_delay_s = {ms:.6g}")
    ),
    "loose mount": Change("[emulation.manipulator]\nmount_play_um = {x:.4g}", 0.0, 6.0),
    "stroke of the stacks": Change("[emulation.stack]\nstroke_um_at_100_V = {x:.4g}", 15.0, 1.2),
    "filter of the sensors": Change(
        "[emulation.sensors]\nrc_farad = {x:.4g}e-6", 0.33, 0.1,
        (r"^\[firmware.sensing\].*$", "[firmware.sensing]\nfilter_farad = {x:.4g}e-6"),
    ),
    "manipulator turned in its mount": Change("[emulation.manipulator]\nmount_spread_deg = {x:.4g}", 0.5, 3.5),
}  # fmt: skip
JUDGES = 16


def size_of(name: str, seed: int) -> float:
    """Draw the size of a change."""
    change = CHANGES[name]
    rng = np.random.default_rng([seed, list(CHANGES).index(name)])
    return change.nominal + change.span * float(rng.uniform(0.6, 1.4))


def write_bench(file: Path, seed: int, emulation: str, told: tuple[str, str] | None = None) -> Path:
    """Write the default bench with this seed and table of its emulation."""
    source = bench_file("micron")
    text = source.read_text().replace('"calibration/', f'"{source.parent.resolve()}/calibration/')
    text = text.replace("[bus.daq0]", f"{emulation}\n\n[bus.daq0]", 1)
    edits = [(r"^seed = 1\b", f"seed = {seed}"), *([told] if told is not None else [])]
    for pattern, new in edits:
        text, count = re.subn(pattern, new, text, flags=re.MULTILINE)
        assert count == 1, pattern
    file.parent.mkdir(parents=True, exist_ok=True)
    write_text_atomic(file, text)
    return file


def run_one(
    name: str, seed: int, folder: Path, seconds: float, unchanged: TipError, *, with_names: bool
) -> dict[str, Any]:
    """Heal one bench; the tip error of the judging runs before, after and with the physics known, as a row."""
    began = time.process_time()
    change, x = CHANGES[name], size_of(name, seed)
    judges = judging(seed)
    table = change.emulation.format(x=x)
    path = write_bench(folder / "bench.toml", seed, table)
    parts = (replace(PARTS[0], identify=lambda lab: identify_once(lab, folder.parent)), *PARTS[1:])
    found = heal(path, folder, seconds=seconds, runs=8, name_effects=with_names, say=lambda text: None, parts=parts)
    before = tip_error(load_bench(path), seconds, judges)
    after = before if found.bench is None else tip_error(load_bench(Path(found.bench)), seconds, judges)
    known = unchanged
    if change.told is not None:
        told = (change.told[0], change.told[1].format(x=x, ms=0.0017 + 1e-3 * x))
        known = tip_error(load_bench(write_bench(folder / "known.toml", seed, table, told)), seconds, judges)
    steps = [
        {
            k: getattr(s, k)
            for k in ("part", "difference", "unit", "effects", "no_remedy", "split", "kept", "why", "balance")
        }
        for s in found.steps
    ]
    return {
        "change": name,
        "seed": seed,
        "revision": revision_and_day(),
        "table": table,
        "with_names": with_names,
        "before": before.mean(),
        "after": after.mean(),
        "known": known.mean(),
        "worse": list(rises(before, after).values()),
        "steps": steps,
        "cpu_s": round(time.process_time() - began, 1),
    }


def identify_once(lab: Lab, home: Path) -> Path:
    """Return the calibration of the lab's stacks, made once for all benches whose stacks are the same."""
    c = lab.config
    key = repr((c.stack, c.amplifier, c.environment, c.unit, c.seed))
    file = home / f"stacks-{hashlib.sha256(key.encode()).hexdigest()[:16]}.toml"
    if not file.exists():
        write_text_atomic(file, PARTS[0].identify(lab).read_text())
    return file


def judging(seed: int) -> range:
    """Return the seeds of the runs that judge."""
    return range(10 * seed, 10 * seed + JUDGES)


def table(rows: Sequence[dict[str, Any]]) -> str:
    """Tip error (um rms) of each bench, before -> after (with the physics known), by band, and what was done."""
    lines = ["| concealed change | " + " | ".join((*BANDS, WHOLE)) + " | kept | without a remedy |", "|---" * 8 + "|"]
    for r in rows:
        size = ", ".join(re.findall(r"^\w+ = .*$", r["table"], re.MULTILINE))
        cells = [f"{r['before'][b]:.2f} -> {r['after'][b]:.2f} ({r['known'][b]:.2f})" for b in (*BANDS, WHOLE)]
        cells += [", ".join(s["part"] for s in r["steps"] if s["kept"]) or "none"]
        cells += ["; ".join(e.replace("_", " ") for s in r["steps"] for e in s["no_remedy"]) or "none"]
        lines.append(f"| {r['change']}{f' ({size})' if size else ''} | " + " | ".join(cells) + " |")
    return "\n".join(lines)


def page(rows: Sequence[dict[str, Any]], seconds: float) -> str:
    """Return the result's page."""
    seed, revisions = rows[0]["seed"], "; ".join(dict.fromkeys(r["revision"] for r in rows))
    worse = [f"{r['change']}: {', '.join(r['worse'])}" for r in rows if r["worse"]]
    missing = [name for name in CHANGES if name not in {r["change"] for r in rows}]
    reverted = [f"{r['change']}, {s['part']}: {s['why']}" for r in rows for s in r["steps"] if not s["kept"]]
    stamps = {r["revision"].partition(",")[0] for r in rows}
    known = [r["known"]["8-12 Hz"] for r in rows if CHANGES[r["change"]].told is None]
    mixed = (
        f"""- The rows are of {len(stamps)} revisions, between which the firmware changed: compare each with its known
  figures (8-12 Hz: {min(known):.2f} to {max(known):.2f} um on the unchanged bench).
"""
        if len(stamps) > 1 and known
        else ""
    )
    kept = [
        f"{r['change']}, {s['part']}: {s['why']}{s['balance'] and '; tremor estimator: '}{s['balance']}"
        for r in rows
        for s in r["steps"]
        if s["kept"]
    ]
    return f"""# Benches that were healed

Made by `python -m tools.research.prove.heal_measure --seed {seed} --keep FOLDER --out docs/results/heal.json`,
revision {revisions}; do not edit. Tip error in um rms against the intended path, before -> after `micron mismatch heal`
(with the physics known): mean of {JUDGES} runs of {seconds:g} s whose hands neither tried a remedy nor decided. Known
is the changed bench with the firmware told of the filter or the delay; else the unchanged bench, which no compensation
can reach where there is no remedy. Both have the estimator's weights of the bench that ships; heal may change them
beside a remedy. A run without wires: the amplifier's monitor, which stops the instrument at its tolerance of 0.3 V, is
not in it.

{table(rows)}

- Benches with a band that is worse than before (paired t-test over the judging runs, level {LEVEL:g}):
  {"; ".join(worse) or "none"} of {len(rows)}.
- Not run: {", ".join(missing) or "none"}.
{mixed}- The engine was not asked for names, which do not change the remedies (`--without-names`):
  {sum(not r["with_names"] for r in rows)} of {len(rows)}.
- CPU: {sum(r["cpu_s"] for r in rows):.0f} s.

## Kept remedies

{chr(10).join(f"- {k}" for k in kept) or "- nothing"}

## Reverted remedies

{chr(10).join(f"- {k}" for k in reverted) or "- nothing"}
"""


def main(arguments: Sequence[str] | None = None) -> None:
    """Heal what is not done yet and print the table."""
    parser = argparse.ArgumentParser(description="Measure what healing does to benches with a concealed change.")
    parser.add_argument("--keep", type=Path, required=True, help="rows.jsonl there; a stopped run goes on")
    parser.add_argument("--seed", type=int, required=True, help="draws sizes, noise and hands")
    parser.add_argument("--seconds", type=float, default=12.0)
    parser.add_argument("--minutes", type=float, default=float("inf"), help="begin no bench after these")
    parser.add_argument(
        "--without-names", action="store_true", help="leave the engine out: the tip is the same, sooner"
    )
    parser.add_argument("--out", type=Path, metavar="FILE", help="write the result there (.json or .md)")
    options = parser.parse_args(arguments)
    options.keep.mkdir(parents=True, exist_ok=True)
    file = options.keep / "rows.jsonl"
    rows = [r for r in read_rows(file) if r["seed"] == options.seed] if file.is_file() else []
    ahead = [name for name in CHANGES if name not in {r["change"] for r in rows}]
    began = time.monotonic()
    unchanged: TipError | None = None
    for name in ahead:
        if time.monotonic() - began > 60 * options.minutes:
            break
        if unchanged is None:
            bench = load_bench(write_bench(options.keep / "unchanged.toml", options.seed, ""))
            unchanged = tip_error(bench, options.seconds, judging(options.seed))
        folder = options.keep / str(options.seed) / re.sub(r"\W+", "-", name)
        rows.append(
            run_one(name, options.seed, folder, options.seconds, unchanged, with_names=not options.without_names)
        )
        with file.open("a") as out:
            out.write(json.dumps(rows[-1]) + "\n")
    if not rows:
        return
    print(table(rows))
    if options.out is not None:
        write_result(options.out, page(rows, options.seconds))


if __name__ == "__main__":
    main()
