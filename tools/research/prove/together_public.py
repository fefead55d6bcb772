"""Diagnoses public measured sets that hold several recordings of one machine, each set as one.

``python -m tools.research.prove.together_public --data FOLDER --keep FOLDER --out FILE`` goes on where it stopped. The
data are those of ``micron reproduce measured``; the sets were looked at while the engine was developed.
"""

from __future__ import annotations

import argparse
import itertools
import json
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from threadpoolctl import threadpool_limits

from tools.mismatch.engine.report import Report
from tools.mismatch.infer import diagnose
from tools.mismatch.recording import Recording, Split
from tools.mismatch.recording_load import load
from tools.mismatch.together import join, load_together
from tools.research.prove.harness import read_rows
from tools.research.results.artefact import write_result
from tools.research.stamp import revision_and_day


@dataclass(frozen=True)
class PublicSet:
    """Names the ``files`` of a set below the data's folder; with ``edges`` (samples) its only file is cut there."""

    title: str
    files: tuple[str, ...]
    edges: tuple[int, ...] = ()


SETS = {
    "drives-prbs": PublicSet(
        "two motors and a belt, PRBS of three levels",
        tuple(f"coupled_electric_drives/prbs_{v}.toml" for v in ("0V5", "1V0", "1V5")),
    ),
    "drives-uniform": PublicSet(
        "two motors and a belt, uniform input of two levels",
        tuple(f"coupled_electric_drives/uniform_{v}.toml" for v in ("low", "high")),
    ),
    "tanks": PublicSet("two tanks", ("cascaded_tanks/recording.toml", "cascaded_tanks/test.toml")),
    "piezo": PublicSet(
        "piezo stage", tuple(f"piezo_micromanipulator_dbo/{name}.toml" for name in ("train", "test"))
    ),
    "silverbox": PublicSet(
        "circuit, ten multisines", ("silverbox/recording.toml",), tuple(range(40_650, 127_401, 8675))
    ),
    "shaker": PublicSet(
        "accelerometer on a shaker, a sweep and its repeat",
        tuple(f"accelerometer_package_vs_reference/sweep_0_1{of}.toml" for of in ("", "_repeat")),
    ),
    "emps": PublicSet("positioning axis (EMPS)", ("emps/train.toml", "emps/test.toml")),
}  # fmt: skip


def stretch(recording: Recording, start: int, stop: int) -> Recording:
    """Return the samples from ``start`` to ``stop`` as a recording without a split."""
    signals = {
        kind: {s: x[start:stop] for s, x in getattr(recording, kind).items()}
        for kind in ("inputs", "outputs", "context")
    }
    return replace(recording, t=recording.t[start:stop], split=Split(), segments=(), parts=(), **signals)


def joined(of: PublicSet, data: Path) -> Recording:
    """Return the recordings of a set as one. Raises RecordingError or InputError if a file is not there."""
    if not of.edges:
        return load_together([data / f for f in of.files])
    whole = load(data / of.files[0])
    return join({f"{k}": stretch(whole, a, b) for k, (a, b) in enumerate(itertools.pairwise(of.edges), 1)})


def run_one(name: str, data: Path) -> dict[str, Any]:
    """Diagnose the set ``name``; the outcome as a row. Linear algebra runs on one thread."""
    recording = joined(SETS[name], data)
    began = time.process_time()
    with threadpool_limits(1):
        report = diagnose(recording, jobs=1)
    return {
        "set": name, "revision": revision_and_day(), "recordings": len(recording.parts), "samples": recording.n,
        "cpu_s": round(time.process_time() - began), **_answers(report),
    }  # fmt: skip


def _answers(report: Report) -> dict[str, Any]:
    together, fit = report.together, report.fit
    assert together is not None
    return {
        "verdict": report.verdict,
        "names": {p.name: p.confidence for p in report.physics},
        "alike": [list(e.names) for e in report.equivalent],
        "unit": dict(fit.unit),
        "as_given": dict(fit.base_rms),
        "recalibrated": dict(together.rms_recalibrated),
        "fitted": dict(together.rms_fitted),
        "floor": {o: list(v) for o, v in fit.noise_floor_interval.items()},
        "floor_from": dict(fit.noise_method),
        "changes": [f"{c.parameter}: {c.condition}" for c in together.changes],
    }


def _named(row: Mapping[str, Any]) -> str:
    names = ", ".join(f"{n.replace('_', ' ')} {100 * p:.0f} %" for n, p in row["names"].items()) or "nothing"
    alike = "; ".join(" = ".join(n.replace("_", " ") for n in g) for g in row["alike"])
    return f"{names} ({alike})" if alike else names


def page(rows: Sequence[Mapping[str, Any]]) -> str:
    """Return the result's page."""
    revisions = "; ".join(dict.fromkeys(str(r["revision"]) for r in rows))
    lines: list[str] = []
    for row in sorted(rows, key=lambda r: list(SETS).index(r["set"])):
        for k, (o, unit) in enumerate(row["unit"].items()):
            first = (SETS[row["set"]].title, row["recordings"], row["samples"], row["cpu_s"]) if k == 0 else ("",) * 4
            answer = (row["verdict"].replace("_", " "), _named(row)) if k == 0 else ("", "")
            rms = (row[key][o] for key in ("as_given", "recalibrated", "fitted"))
            low, high = row["floor"][o]
            figures = (f"{o} ({unit})", *(f"{v:.3g}" for v in rms), f"{low:.3g} to {high:.3g}, {row['floor_from'][o]}")
            lines.append(f"| {' | '.join(map(str, (*first, *answer, *figures)))} |")
    left = ", ".join(SETS[name].title for name in SETS if name not in {r["set"] for r in rows}) or "none"
    return f"""# Measured sets of several recordings

Made by `python -m tools.research.prove.together_public --data FOLDER --keep FOLDER --out
docs/results/together-public.json`, revision {revisions}; do not edit.

Each set is one `diagnose --together`. The residual is rms of the recordings that the fit left out, in turn: twin as
given, recalibrated, and with what was named. The sets were looked at during development.

| set | recordings | samples | CPU s | verdict | named | output | as given | recalibrated | named | noise, from |
|---|---|---|---|---|---|---|---|---|---|---|
{chr(10).join(lines)}

- Not run: {left}.
"""


def main(arguments: Sequence[str] | None = None) -> None:
    """Run what is not done yet and print the page."""
    parser = argparse.ArgumentParser(description="Diagnose public sets of several recordings together.")
    parser.add_argument("--data", type=Path, required=True, help="folder of the public recordings")
    parser.add_argument("--keep", type=Path, required=True, help="rows.jsonl there; a stopped run goes on")
    parser.add_argument("--set", nargs="+", choices=tuple(SETS), default=list(SETS))
    parser.add_argument("--out", type=Path, metavar="FILE", help="write the result there (.json or .md)")
    options = parser.parse_args(arguments)
    missing = [f for name in options.set for f in SETS[name].files if not (options.data / f).is_file()]
    if missing:
        parser.error(f"{options.data}: holds no {missing[0]}; name the folder of the public recordings")
    options.keep.mkdir(parents=True, exist_ok=True)
    file = options.keep / "rows.jsonl"
    rows = read_rows(file)
    done = {r["set"] for r in rows}
    for name in options.set:
        if name in done:
            continue
        rows.append(run_one(name, options.data))
        with file.open("a", encoding="utf-8") as out:
            out.write(json.dumps(rows[-1]) + "\n")
    if not rows:
        return
    text = page(rows)
    print(text)
    if options.out is not None:
        write_result(options.out, text)


if __name__ == "__main__":
    main()
