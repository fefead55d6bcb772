"""How often the tool blames something when nothing is missing: null simulations over all twins and noises."""

from __future__ import annotations

import json
import sys
import tempfile
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from scipy.stats import beta

from tools.mismatch.prove import draw, seal
from tools.mismatch.prove.catalog import TWINS
from tools.mismatch.prove.noise import KINDS
from tools.mismatch.prove.proof import generate
from tools.mismatch.prove.runner import Diagnose, diagnose_all, tool
from tools.mismatch.prove.score import FALSE_ALARM, names_of

DOC = Path("docs/mismatch-false-alarms.md")


@dataclass(frozen=True)
class NullResult:
    """``rows``: one per recording (twin, noise, kind, verdict, said, alarm)."""

    seed: int
    rows: tuple[dict[str, Any], ...]
    seconds: float

    def count(self, **where: str) -> tuple[int, int]:
        """(false alarms, recordings) among the rows that match."""
        rows = [r for r in self.rows if all(r[k] == v for k, v in where.items())]
        return sum(r["alarm"] for r in rows), len(rows)


def clopper_pearson(k: int, n: int, level: float = 0.95) -> tuple[float, float]:
    """Exact two-sided interval of a share (Clopper and Pearson, 1934)."""
    tail = (1.0 - level) / 2.0
    low = 0.0 if k == 0 else float(beta.ppf(tail, k, n - k + 1))
    high = 1.0 if k == n else float(beta.ppf(1.0 - tail, k + 1, n - k))
    return low, high


def null_plans(n: int) -> tuple[list[draw.Plan], list[str]]:
    """Every twin with every noise in turn; two of three agree as given, one needs recalibration."""
    plans: list[draw.Plan] = []
    kinds: list[str] = []
    for i in range(n):
        twin = TWINS[i % len(TWINS)]
        kind = "recalibrate" if (i // (len(TWINS) * len(KINDS))) % 3 == 2 else "agrees"
        if twin == "accelerometer_cluster":
            kind = "agrees"  # its only base parameters, the positions, are an effect of their own
        plans.append(draw.Plan(kind, twin, (), draw.SEVERITIES[i % 4]))
        kinds.append(KINDS[(i // len(TWINS)) % len(KINDS)])
    return plans, kinds


BATCH = 4


def _batch(
    seed: int, plans: Sequence[draw.Plan], kinds: Sequence[str], jobs: int, max_samples: int, diagnose: Diagnose
) -> list[dict[str, Any]]:
    with tempfile.TemporaryDirectory(prefix="micron-nulls-") as tmp:
        paths, answers = generate(
            seed, plans, Path(tmp) / "recordings", jobs=jobs, max_samples=max_samples, each_noise=kinds
        )
        digest = seal.close(answers, Path(tmp) / "sealed")
        reports = {name: report for name, report, _ in diagnose_all(paths, jobs, diagnose)}
        rows: list[dict[str, Any]] = []
        for name, answer in sorted(seal.opened(Path(tmp) / "sealed", digest).items()):
            verdict = str(reports[name]["verdict"])
            rows.append(
                {
                    "seed": seed,
                    "case": name,
                    "twin": answer["twin"],
                    "noise": answer["noise_kind"],
                    "kind": answer["kind"],
                    "declared": answer["noise_declared"],
                    "excitation": answer["excitation"],
                    "verdict": verdict,
                    "said": names_of(reports[name]),
                    "error": reports[name].get("error"),
                    "alarm": verdict in FALSE_ALARM,
                    "failed": verdict == "error",
                }
            )
    return rows


def nulls(
    n: int = 300,
    seed: int | None = None,
    jobs: int = 2,
    *,
    doc: Path | None = DOC,
    rows_file: Path | None = None,
    max_samples: int = 12_000,
    diagnose: Diagnose = tool,
    say: Callable[[str], None] | None = None,
) -> NullResult:
    """Run ``n`` null recordings; write ``doc`` unless None.

    ``rows_file`` (JSON) keeps the rows after every batch; what it already holds counts, so that a run of hours may be
    interrupted and continued. It must come from the same state of the tool: remove it when the tool changes.
    """
    start = time.perf_counter()
    tell = say or (lambda text: print(text, file=sys.stderr, flush=True))
    seed = int(time.time_ns() % 1_000_000_007) if seed is None else seed
    rows: list[dict[str, Any]] = []
    before = 0.0
    if rows_file is not None and rows_file.exists():
        kept = json.loads(rows_file.read_text())
        rows, before = kept["rows"], float(kept["seconds"])
    plans, kinds = null_plans(n)
    tell(f"seed {seed}, {n} null recordings, {len(rows)} of them done before")
    for first in range(len(rows), n, BATCH):
        part = slice(first, min(first + BATCH, n))
        rows += _batch(seed + first, plans[part], kinds[part], jobs, max_samples, diagnose)
        seconds = before + time.perf_counter() - start
        if rows_file is not None:
            rows_file.write_text(json.dumps({"seconds": seconds, "rows": rows}, indent=1))
        tell(f"{len(rows)}/{n}, {sum(r['alarm'] for r in rows)} false alarms, {seconds:.0f} s")
    result = NullResult(seed, tuple(rows), before + time.perf_counter() - start)
    if doc is not None:
        doc.parent.mkdir(parents=True, exist_ok=True)
        doc.write_text(document(result))
    return result


def _cell(k: int, n: int) -> str:
    low, high = clopper_pearson(k, n)
    return f"{k} of {n} ({100 * low:.1f} to {100 * high:.1f} %)"


def _by(result: NullResult, key: str, values: Sequence[str]) -> list[str]:
    lines = [f"| {key} | false alarms (95 % interval) |", "|---|---|"]
    for v in values:
        k, n = result.count(**{key: v})
        if n:
            lines.append(f"| {v} | {_cell(k, n)} |")
    return lines


def document(result: NullResult, note: str = "") -> str:
    """The text of docs/mismatch-false-alarms.md. ``note`` on the state of the tool and what was not run."""
    k, n = result.count()
    failed = sum(r["failed"] for r in result.rows)
    named: dict[str, int] = {}
    for r in result.rows:
        if r["alarm"]:
            word = r["said"][0] if r["said"] else "unexplained"
            named[word] = named.get(word, 0) + 1
    false_names = sum(bool(r["said"]) and r["alarm"] for r in result.rows)
    exact = sum(r["verdict"] == r["kind"] for r in result.rows)
    lines = [
        "# False alarms of the mismatch tool",
        "",
        "Made by `python -m tools.mismatch.prove.nulls`; do not edit. Recordings in which no physics is missing, "
        "drawn by the blind prover's own simulator over all twins and excitations, with white, coloured, "
        "heavy-tailed and quantised noise, the noise declared in half of them; two thirds agree as given, "
        "one third needs recalibration. A false alarm is the verdict `missing_physics` or `unexplained`. "
        "Intervals are Clopper-Pearson, 95 %.",
        "",
        *([note, ""] if note else []),
        f"{n} recordings, {result.seconds:.0f} s; seeds {', '.join(sorted({str(r['seed']) for r in result.rows}))}.",
        "",
        f"- false alarms: {_cell(k, n)}",
        f"- of these with a false name: {_cell(false_names, n)}",
        f"- verdict exactly right (`agrees` or `recalibrate`): {exact} of {n}",
        f"- crashed or refused: {failed} of {n}",
        "",
        *_by(result, "twin", TWINS),
        "",
        *_by(result, "noise", KINDS),
        "",
        *_by(result, "kind", ("agrees", "recalibrate")),
        "",
        "What was blamed: " + (", ".join(f"{w} {c}" for w, c in sorted(named.items())) or "nothing") + ".",
        "",
    ]
    return "\n".join(lines)


def main() -> None:
    import argparse
    import os

    for key in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS"):
        os.environ.setdefault(key, "1")
    p = argparse.ArgumentParser(description="null simulations: false-alarm rate with its confidence bound")
    p.add_argument("--n", type=int, default=300)
    p.add_argument("--seed", type=int, default=None)
    p.add_argument("--jobs", type=int, default=2)
    p.add_argument("--max-samples", type=int, default=12_000)
    p.add_argument("--doc", type=Path, default=DOC)
    p.add_argument("--rows", type=Path, default=None, help="JSON kept after every batch, and continued from")
    a = p.parse_args()
    print(document(nulls(a.n, a.seed, a.jobs, doc=a.doc, rows_file=a.rows, max_samples=a.max_samples)))


if __name__ == "__main__":
    main()
