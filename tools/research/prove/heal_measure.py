"""Benches with a concealed change: the tip error before and after ``micron mismatch heal``, beside the unchanged bench.

``python -m tools.research.prove.heal_measure --keep FOLDER`` goes on where it stopped. The unchanged bench, whose
calibration knows its physics, is the best that a heal can reach. The seeds that judge are none of those that heal.
"""

from __future__ import annotations

import argparse
import json
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from hal.bench import load_bench
from tools.emulate.shipped import bench_file
from tools.heal.figures import BANDS, WHOLE, tip_error
from tools.heal.heal import heal
from tools.output import write_text_atomic
from tools.research.prove.harness import read_rows

CHANGES: dict[str, str] = {
    "none": "",
    "stack hysteresis": "[emulation.stack]\nslip_sum = 0.62",
    "gain of amplifier and stack 8 % up": "[emulation.stack]\nstroke_um_at_100_V = 16.2",
    "accelerometers turned by a degree": "[emulation.sensors]\nmisalignment_deg = 1.5",
    "filter of the sensors slower": "[emulation.sensors]\nrc_farad = 0.43e-6",
    "manipulator turned in its mount": "[emulation.manipulator]\nmount_spread_deg = 4.0",
}
"""Tables of ``[emulation]`` that the healer does not read: it sees what the lab measures."""
JUDGED = tuple(range(6000, 6016))


def concealed(folder: Path, table: str) -> Path:
    """The default bench with a table of its emulation added."""
    source = bench_file("micron")
    text = source.read_text().replace('"calibration/', f'"{source.parent.resolve()}/calibration/')
    file = folder / "bench.toml"
    write_text_atomic(file, text.replace("[bus.daq0]", f"{table}\n\n[bus.daq0]", 1))
    return file


def run_one(name: str, folder: Path, seconds: float) -> dict[str, Any]:
    """Heal one bench; the tip error on ``JUDGED`` before, after and with the physics known, as a row."""
    began = time.process_time()
    folder.mkdir(parents=True, exist_ok=True)
    path = concealed(folder, CHANGES[name])
    found = heal(path, folder, seconds=seconds, runs=8, say=lambda text: None)
    files = {"before": path, "after": Path(found.bench or path), "known": bench_file("micron")}
    row = {k: tip_error(load_bench(f), seconds, JUDGED).mean() for k, f in files.items()}
    steps = [
        {k: getattr(s, k) for k in ("part", "difference", "unit", "effects", "split", "kept", "why", "after")}
        for s in found.steps
    ]
    return {"change": name, **row, "steps": steps, "cpu_s": round(time.process_time() - began, 1)}


def table(rows: Sequence[dict[str, Any]]) -> str:
    """Tip error (um rms) of each bench, before -> after (with the physics known), by band."""
    lines = ["| concealed change | " + " | ".join((*BANDS, WHOLE)) + " |", "|---" * 6 + "|"]
    for r in rows:
        cells = [f"{r['before'][b]:.2f} -> {r['after'][b]:.2f} ({r['known'][b]:.2f})" for b in (*BANDS, WHOLE)]
        lines.append(f"| {r['change']} | " + " | ".join(cells) + " |")
    return "\n".join(lines)


def main(arguments: Sequence[str] | None = None) -> None:
    """Heal what is not done yet and print the table."""
    parser = argparse.ArgumentParser(description="Measure what healing does to benches with a concealed change.")
    parser.add_argument("--keep", type=Path, required=True, help="rows.jsonl there; a stopped run goes on")
    parser.add_argument("--seconds", type=float, default=12.0)
    parser.add_argument("--minutes", type=float, default=float("inf"), help="begin no bench after these")
    options = parser.parse_args(arguments)
    options.keep.mkdir(parents=True, exist_ok=True)
    file = options.keep / "rows.jsonl"
    rows = read_rows(file)
    began = time.monotonic()
    for name in CHANGES:
        if name in {r["change"] for r in rows}:
            continue
        if time.monotonic() - began > 60 * options.minutes:
            break
        rows.append(run_one(name, options.keep / name.replace(" ", "-"), options.seconds))
        with file.open("a") as out:
            out.write(json.dumps(rows[-1]) + "\n")
    print(table(rows))


if __name__ == "__main__":
    main()
