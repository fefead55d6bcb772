"""`python -m tools.research.prove.foreign --seed N`: a simulation that is not ours, through every kind of twin.

The motor of ``examples/motor`` is drawn anew, with and without physics that its twins lack, and each recording is
diagnosed through equations, a Python object, both types of FMU, a state space and columns. Rows are kept after every
case and continued from; the page is docs/results/mismatch-foreign.json.
"""

from __future__ import annotations

import argparse
import importlib
import json
import subprocess
import sys
import tempfile
import time
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from firmware_py.recording.revision import git_revision
from hal.trust import decide, trust_program
from tools.mismatch.engine.report import Report
from tools.mismatch.infer import diagnose
from tools.mismatch.recording_load import load
from tools.research.results.artefact import write_result

EXAMPLE = Path(__file__).parents[3] / "examples" / "motor"
FRICTION = ("coulomb_friction", "stribeck_friction")
TRUTH: Mapping[str, tuple[tuple[str, ...], ...]] = {
    "nothing": (),
    "backlash": (("backlash",),),
    "friction": (FRICTION,),
    "friction_and_backlash": (FRICTION, ("backlash",)),
    "delay": (("dead_time",),),
    "gravity": (("gravity_load",),),
    "saturation": (("saturation",),),
    "stribeck": (FRICTION,),
}
"""Names of what each recording has; any name of a tuple is right. Coulomb friction is Stribeck's without breakaway."""
TWINS = ("ode", "python", "state_space", "fmu_me", "fmu_cs", "columns")
CLAIMED = 0.5
"""A name that is surer than this is claimed."""
Row = dict[str, Any]


def make_recordings(folder: Path, seed: int, *more: str) -> None:
    """Let the example write its recordings of the motor ``seed`` below ``folder``, and trust what it builds."""
    command = [sys.executable, "make.py", str(folder.resolve()), "--seed", str(seed), *more]
    subprocess.run(command, cwd=EXAMPLE, check=True, timeout=600)
    for fmu in folder.glob("*/*.fmu"):
        trust_program(fmu)


def install_python_twin(folder: Path) -> None:
    """Put the Python twin below ``folder`` and on the path, as ``pip install`` would."""
    about = folder / "motor_twin-1.0.dist-info"
    about.mkdir(parents=True, exist_ok=True)
    source = folder / "motor_twin.py"
    source.write_text((EXAMPLE / "motor_twin.py").read_text(encoding="utf-8"), encoding="utf-8")
    (about / "METADATA").write_text("Metadata-Version: 2.1\nName: motor-twin\nVersion: 1.0\n")
    (about / "entry_points.txt").write_text("[micron.twins]\nmotor = motor_twin:Motor\n")
    decide("run", f"package motor_twin at {source}", "motor_twin:Motor")  # this program installed it
    if str(folder) not in sys.path:
        sys.path.insert(0, str(folder))
    importlib.invalidate_caches()


def judged(variant: str, report: Report) -> str:
    """``right``: every name and no other; ``part``: some of the names; ``advice``: unexplained, with the kind of twin
    that would say more; ``unexplained``; ``missed``: no difference seen; ``wrong``: another name is claimed.
    """
    claimed = {p.name for p in report.physics if p.confidence > CLAIMED}
    truth = TRUTH[variant]
    if claimed - {name for names in truth for name in names}:
        return "wrong"
    if report.verdict in ("agrees", "recalibrate"):
        return "missed" if truth else "right"
    if truth and all(claimed & set(names) for names in truth):
        return "right"
    if report.verdict == "unexplained":
        return "advice" if report.not_tried else "unexplained"
    return "part" if claimed else "unsure"


def diagnosed(recording: Path, variant: str, twin: str) -> Row:
    """Return a row of the table, which also records an exception of the engine."""
    began = time.process_time()
    row: Row = {"variant": variant, "twin": twin}
    try:
        report = diagnose(load(recording), jobs=1)
    except Exception as error:  # a crash is a result
        return row | {
            "judged": "failed",
            "verdict": f"{type(error).__name__}: {error}"[:200],
            "names": [],
            "left": None,
        }
    fit = report.fit
    return row | {
        "judged": judged(variant, report),
        "verdict": report.verdict,
        "names": [[p.name, p.confidence] for p in report.physics],
        "left": max(fit.fitted_rms[o] / max(fit.noise_floor_rms[o], 1e-300) for o in fit.fitted_rms),
        "summary": report.summary,
        "cpu_s": time.process_time() - began,
    }


def page(runs: Sequence[Mapping[str, Any]]) -> str:
    """The text of docs/results/mismatch-foreign.json."""
    rows = [row for run in runs for row in run["rows"]]
    tally = {
        w: sum(r["judged"] == w for r in rows) for w in ("right", "part", "advice", "unexplained", "unsure", "missed")
    }
    bad = {w: sum(r["judged"] == w for r in rows) for w in ("wrong", "failed")}
    cpu = sorted(r["cpu_s"] for r in rows if "cpu_s" in r)
    lines = [
        "# A simulation that is not ours",
        "",
        "Made by `python -m tools.research.prove.foreign`; do not edit. The motor of `examples/motor` integrates"
        " itself; each seed draws all its values, and its data sheet is a few per cent off. `right`: every name and no"
        " other is surer than 50 %; `part`: some of the names; `advice`: `unexplained`, with the kind of twin that"
        " would say more; `unsure`: no name is surer than 50 %; `missed`: no difference seen; `wrong`: another name"
        " is surer than 50 %. The eccentric load has to be named `gravity_load`; before there was that name, `cogging`"
        " was right.",
        "",
        f"{len(rows)} cases: " + ", ".join(f"{w} {k}" for w, k in {**tally, **bad}.items() if k or w in bad) + ".",
    ]
    if cpu:
        lines.append(f"CPU of a diagnosis: median {cpu[len(cpu) // 2]:.0f} s, longest {cpu[-1]:.0f} s.")
    for run in runs:
        found = {(r["variant"], r["twin"]): r for r in run["rows"]}
        ran = f"{len(run['rows'])} of {len(TRUTH) * len(TWINS)} cases were run"
        lines += ["", f"## Seed {run['seed']}, {run['kind']}", ""]
        lines += [f"Tool {run['revision'][:12]}, {run['date']}; {ran}.", ""]
        lines += [
            "| recording | twin | judged | verdict | names (sure) | left, times the noise | CPU s |",
            "|---" * 7 + "|",
        ]
        for variant in TRUTH:
            for twin in TWINS:
                if (row := found.get((variant, twin))) is not None:
                    names = ", ".join(f"{n} ({100 * c:.0f} %)" for n, c in row["names"]) or "none"
                    left = "" if row["left"] is None else f"{row['left']:.2g}"
                    lines.append(
                        f"| {variant} | {twin} | {row['judged']} | {row['verdict']} | {names} | {left} |"
                        f" {row.get('cpu_s', 0.0):.0f} |"
                    )
    return "\n".join([*lines, ""])


def run_cases(
    rows_file: Path, seed: int, kind: str, variants: Sequence[str], twins: Sequence[str], minutes: float
) -> None:
    """Diagnose what ``rows_file`` does not hold yet, until the minutes are over."""
    runs: list[dict[str, Any]] = json.loads(rows_file.read_text()) if rows_file.exists() else []
    about = {"seed": seed, "kind": kind, "revision": git_revision() or "unknown"}  # another tool makes another table
    run = next((r for r in runs if about.items() <= r.items()), None)
    if run is None:
        run = about | {"date": time.strftime("%Y-%m-%d"), "rows": []}
        runs.append(run)
    done = {(r["variant"], r["twin"]) for r in run["rows"]}
    until = time.monotonic() + 60.0 * minutes
    with tempfile.TemporaryDirectory(prefix="micron-motor-") as tmp:
        folder = Path(tmp)
        make_recordings(folder, seed)
        install_python_twin(folder / "packages")
        for variant in variants:
            for twin in twins:
                recording = folder / variant / f"{twin}.toml"
                if (variant, twin) in done or not recording.exists():
                    continue
                if time.monotonic() > until:
                    return
                row = diagnosed(recording, variant, twin)
                run["rows"].append(row)
                rows_file.write_text(json.dumps(runs, indent=1))
                print(f"{variant} {twin}: {row['judged']} {row['names']} {row.get('cpu_s', 0.0):.0f} s", flush=True)


def main() -> int:
    """Exit 2 on bad input."""
    p = argparse.ArgumentParser(prog="python -m tools.research.prove.foreign", description=__doc__)
    p.add_argument("--seed", type=int, help="motor to draw; without it only the page is written")
    p.add_argument("--rows", type=Path, default=Path("foreign.json"), help="rows, kept after every case")
    p.add_argument("--minutes", type=float, default=1e9, help="begin no case after these")
    p.add_argument("--kind", choices=("development", "result"), default="result", help="what the seed was drawn for")
    p.add_argument("--variants", nargs="*", choices=tuple(TRUTH), default=tuple(TRUTH))
    p.add_argument("--twins", nargs="*", choices=TWINS, default=TWINS)
    p.add_argument("--out", type=Path, required=True, metavar="FILE", help="the result (FILE.json) or its page")
    a = p.parse_args()
    if not EXAMPLE.is_dir():
        p.error(f"{EXAMPLE} is not here; run it in the project's folder")
    try:
        if a.seed is not None:
            run_cases(a.rows, a.seed, a.kind, a.variants, a.twins, a.minutes)
        runs = json.loads(a.rows.read_text())
        write_result(a.out, page([r for r in runs if r["kind"] == "result"]))
    except (OSError, ValueError) as error:
        p.error(str(error))
    print(f"page: {a.out}", file=sys.stderr)
    return 0


if __name__ == "__main__":
    sys.exit(main())
