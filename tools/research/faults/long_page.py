"""The page of long runs: each form of run has a block of its own, made anew by ``micron soak --out``."""

from __future__ import annotations

import re
from pathlib import Path

from tools.errors import InputError
from tools.research.faults.long_run import CHANCE, DRIFT, GROWTH_MB, LongRun
from tools.research.results.artefact import read_page

HEAD = f"""# Long runs: what grows, what drifts, what is not counted

Each block is made by the command that it names. Virtual time, scored by eighths of the run. Asked for: memory grows by
less than {GROWTH_MB:g} MB after the first eighth, the part of the tremor that is left stays within {DRIFT:.0%} of its
median (of a short run: within {CHANCE:g} standard errors), every sample and every tick is accounted for, nothing is
noticed. What is left is the tip's distance from the path that the hand intends, tremor the same without compensation;
both without their mean over a fifth of a second, at all frequencies (8 to 12 Hz alone: `micron run`).
`tests/hil/test_time_marks.py` asks that runs across 2^31, 2^32 and 2^53 ns be the run from zero, bit for bit.
"""


def block(run: LongRun, command: str, revision: str) -> str:
    """Return a run as Markdown."""
    columns = ["eighth", "left um", "tremor um", "left %", "memory MB"]
    rows = [
        [f"{k + 1}", f"{left:.2f}", f"{tremor:.2f}", f"{100 * left / tremor:.1f}" if tremor else "-", f"{memory:.2f}"]
        for k, (left, tremor, memory) in enumerate(zip(run.left_um, run.tremor_um, run.memory_MB, strict=True))
    ]
    if run.tilt_mrad is not None:
        columns.append("tilt error mrad")
        for row, tilt in zip(rows, run.tilt_mrad, strict=True):
            row.append(f"{tilt:.3f}")
    table = "\n".join(f"| {' | '.join(cells)} |" for cells in [columns, ["---"] * len(columns), *rows])
    hours = f"{run.seconds / 3600:g} h" if run.seconds >= 3600 else f"{run.seconds / 60:g} min"
    form = "all buses, drivers, supervision and guardian" if run.wires else "without wires"
    marks = f"Marks crossed: {', '.join(f'{mark} ns' for mark in run.marks)}. " if run.marks else ""
    counters = ", ".join(f"{name} {value}" for name, value in run.counters.items())
    return (
        f"## {hours}, {form}\n\n`{command}`, firmware revision {revision}; {run.cpu_s / 60:.1f} min on one core.\n\n"
        f"{table}\n\nMemory grew by {run.growth_MB:.2f} MB; left varied by {100 * run.drift:.1f} % of its median "
        f"(standard error {100 * run.scatter:.1f} %). {marks}Counters: {counters}. Ended: {run.ended}. "
        f"{'Not as asked for: ' + '; '.join(run.problems()) if run.problems() else 'All as asked for'}.\n"
    )


def with_block(path: Path, name: str, text: str) -> str:
    """The page at ``path`` (or a new one) with block ``name`` replaced; other blocks stay. ``InputError`` for a file
    that is not such a page."""
    page = read_page(path) if path.exists() else HEAD
    if not page.startswith(HEAD.splitlines()[0]):
        raise InputError(f"{path}: this is not a page of long runs; give another name to --out")
    others = re.findall(r"<!-- (\w+) -->\n(.*?)<!-- end -->\n", page, re.DOTALL)
    blocks = {**dict(others), name: text}
    return HEAD + "".join(f"\n<!-- {key} -->\n{blocks[key]}<!-- end -->\n" for key in sorted(blocks, reverse=True))
