"""Measures the false-positive rate: null simulations over all twins and noises."""

from __future__ import annotations

import json
import re
import statistics
import sys
import tempfile
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from scipy.stats import beta

from firmware_py.recording.revision import git_revision
from hal.children import use_one_thread
from tools.output import write_text_atomic
from tools.research.prove import draw, seal
from tools.research.prove.catalog import TWINS
from tools.research.prove.noise import KINDS
from tools.research.prove.plans import NOTHING_TO_REFIT, SELDOM
from tools.research.prove.proof import draw_one
from tools.research.prove.runner import Diagnose, in_processes, timed, tool
from tools.research.prove.score import FALSE_ALARM, names_of
from tools.research.results.artefact import read_page, write_result


@dataclass(frozen=True)
class NullResult:
    """``rows``: one per recording (twin, noise, kind, verdict, said, alarm); ``seconds`` of wall time."""

    seed: int
    rows: tuple[dict[str, Any], ...]
    seconds: float
    max_samples: int = 12_000
    revision: str = "unknown"

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
    """Every twin with every noise in turn (an FMU in every second round, the bench in every fourth); two of three agree
    as given, one needs recalibration.
    """
    plans: list[draw.Plan] = []
    kinds: list[str] = []
    for turn in range(n):
        for twin in TWINS:
            if turn % round(1.0 / SELDOM.get(twin, 1.0)):
                continue
            again = (turn // len(KINDS)) % 3 == 2 and twin not in NOTHING_TO_REFIT
            severity = draw.SEVERITIES[len(plans) % 4]
            plans.append(draw.Plan("recalibrate" if again else "agrees", twin, (), severity))
            kinds.append(KINDS[(turn + turn // len(KINDS)) % len(KINDS)])
    return plans[:n], kinds[:n]


@dataclass(frozen=True)
class _Null:
    """Describes a null recording to draw and diagnose."""

    seed: int
    index: int
    plan: draw.Plan
    noise: str
    max_samples: int
    diagnose: Diagnose


def _one(job: _Null) -> dict[str, Any] | None:
    """Draw, seal, diagnose, open; the row. None when the plan cannot be drawn. What it draws depends on seed and index
    alone, so that an interrupted run ends as an uninterrupted one."""
    with tempfile.TemporaryDirectory(prefix="micron-nulls-") as tmp:
        drawn = draw_one((job.seed, job.index, job.plan, Path(tmp) / "recordings", job.max_samples, job.noise))
        if drawn is None:
            return None
        name, answer, path = drawn
        digest = seal.close({name: answer}, Path(tmp) / "sealed")
        done = timed((name, Path(path), job.diagnose))
        answer = seal.opened(Path(tmp) / "sealed", digest)[name]
    verdict = str(done.report["verdict"])
    return {
        "index": job.index,
        "twin": answer["twin"],
        "noise": answer["noise_kind"],
        "kind": answer["kind"],
        "declared": answer["noise_declared"],
        "excitation": answer["excitation"],
        "samples": answer["samples"],
        "verdict": verdict,
        "said": names_of(done.report),
        "error": done.report.get("error"),
        "alarm": verdict in FALSE_ALARM,
        "failed": verdict == "error",
        "cpu_s": round(done.cpu_s, 2),
    }


def nulls(
    n: int = 300,
    seed: int | None = None,
    jobs: int = 2,
    *,
    rows_file: Path | None = None,
    max_samples: int = 12_000,
    diagnose: Diagnose = tool,
    say: Callable[[str], None] | None = None,
) -> NullResult:
    """Run ``n`` null recordings and return their rows.

    ``rows_file`` (JSON) keeps every row as soon as it is there; what it already holds counts, so that a run of hours
    may be interrupted and continued with the same answer. Its seed stands when none is given. ValueError when it comes
    from another seed, record length or state of the tool.
    """
    start = time.perf_counter()
    tell = say or (lambda text: print(text, file=sys.stderr, flush=True))
    revision = git_revision() or "unknown"
    rows: list[dict[str, Any]] = []
    before = 0.0
    if rows_file is not None and rows_file.exists():
        kept = json.loads(rows_file.read_text())
        seed = int(kept["seed"]) if seed is None else seed
        for key, expected in (("seed", seed), ("max_samples", max_samples), ("revision", revision)):
            if kept[key] != expected:
                raise ValueError(f"{rows_file}: made with {key} {kept[key]}, not {expected}; remove it to begin anew")
        rows, before = kept["rows"], float(kept["seconds"])
    seed = int(time.time_ns() % 1_000_000_007) if seed is None else seed
    plans, kinds = null_plans(n)
    done = {r["index"] for r in rows}
    todo = [_Null(seed, i, plans[i], kinds[i], max_samples, diagnose) for i in range(n) if i not in done]
    tell(f"seed {seed}, {n} null recordings, {n - len(todo)} of them done before")
    missed = 0
    for row in in_processes(_one, todo, jobs):
        if row is None:
            missed += 1
            continue
        rows.append(row)
        seconds = before + time.perf_counter() - start
        if rows_file is not None:
            head = {"seed": seed, "max_samples": max_samples, "revision": revision, "seconds": seconds}
            write_text_atomic(rows_file, json.dumps({**head, "rows": rows}, indent=1))
        alarm = f"  FALSE ALARM {row['verdict']} {','.join(row['said'])}" if row["alarm"] else ""
        tell(
            f"{len(rows)}/{n - missed}, {sum(r['alarm'] for r in rows)} false alarms, {seconds:.0f} s  "
            f"#{row['index']} {row['twin']} {row['noise']} {row['cpu_s']:.1f} s of CPU{alarm}"
        )
    rows = sorted((r for r in rows if r["index"] < n), key=lambda r: r["index"])
    return NullResult(seed, tuple(rows), before + time.perf_counter() - start, max_samples, revision)


def kept(file: Path) -> NullResult:
    """Return what a run has kept in its rows file so far, finished or not. ValueError when it is no such file."""
    try:
        body = json.loads(file.read_text())
        rows = sorted(body["rows"], key=lambda r: r["index"])
        return NullResult(body["seed"], tuple(rows), body["seconds"], body["max_samples"], body["revision"])
    except (KeyError, TypeError, json.JSONDecodeError) as error:
        raise ValueError(f"{file}: not the rows of a null run ({error!r})") from error


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


_TOOL_AND_SEED = re.compile(r"seed (\d+), tool (\w+)")
_ALARMS = re.compile(r"^- false alarms: (.+)$", re.MULTILINE)
_EARLIER = "Earlier states of the tool, each with its own seed:"


def earlier_states(page: str, revision: str) -> list[str]:
    """Table rows of what a page says of other states of the tool than this one: those it lists, then its own."""
    _, _, table = page.partition(_EARLIER)
    rows = [line for line in table.splitlines() if line.startswith("| ")][1:]
    made_by, counted = _TOOL_AND_SEED.search(page), _ALARMS.search(page)
    if made_by and counted:
        rows.append(f"| {made_by[2]} | {made_by[1]} | {counted[1]} |")
    return [row for row in rows if not row.startswith(f"| {revision[:12]} ")]


def document(result: NullResult, before: str = "") -> str:
    """Return the page of the result docs/results/mismatch-false-alarms.json.

    ``before`` is the page that it replaces, whose figures stay beside the new ones.
    """
    k, n = result.count()
    failed = sum(r["failed"] for r in result.rows)
    named: dict[str, int] = {}
    for r in result.rows:
        if r["alarm"]:
            word = r["said"][0] if r["said"] else "unexplained"
            named[word] = named.get(word, 0) + 1
    false_names = sum(bool(r["said"]) and r["alarm"] for r in result.rows)
    exact = sum(r["verdict"] == r["kind"] for r in result.rows)
    last = 1 + max((r["index"] for r in result.rows), default=-1)
    cpu_s = statistics.median(r["cpu_s"] for r in result.rows)
    lines = [
        "# False alarms of the mismatch tool",
        "",
        "Made by `python -m tools.research.prove.nulls`; do not edit. Recordings in which no physics is missing, "
        "drawn by the blind prover's own simulators over all twins (FMU and bench less often) and excitations, with "
        "white, coloured, heavy-tailed and quantised noise, the noise declared in half of them; "
        f"{result.count(kind='agrees')[1]} agree as given, {result.count(kind='recalibrate')[1]} need recalibration. "
        "A false alarm is the verdict `missing_physics` or `unexplained`. Intervals are Clopper-Pearson, 95 %.",
        "",
        f"{n} recordings of at most {result.max_samples} samples, seed {result.seed}, tool {result.revision[:12]}, "
        f"{time.strftime('%Y-%m-%d', time.gmtime())}; {result.seconds:.0f} s, median {cpu_s:.1f} s of CPU a recording. "
        f"`--seed {result.seed} --n {last} --max-samples {result.max_samples}` makes them again.",
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
    earlier = earlier_states(before, result.revision)
    if earlier:
        lines += [_EARLIER, "", "| tool | seed | false alarms (95 % interval) |", "|---|---|---|", *earlier, ""]
    return "\n".join(lines)


def main() -> None:
    import argparse

    use_one_thread()
    p = argparse.ArgumentParser(description="null simulations: false-alarm rate with its confidence bound")
    p.add_argument("--n", type=int, default=300)
    p.add_argument("--seed", type=int, default=None)
    p.add_argument("--jobs", type=int, default=2)
    p.add_argument("--max-samples", type=int, default=12_000)
    p.add_argument("--out", type=Path, required=True, metavar="FILE", help="the result (FILE.json) or its page")
    p.add_argument("--rows", type=Path, default=None, help="JSON kept after every recording, and continued from")
    p.add_argument("--page-only", action="store_true", help="no further recording: the page of what --rows holds")
    a = p.parse_args()
    if a.page_only and a.rows is None:
        p.error("--page-only needs --rows")
    try:
        result = (
            kept(a.rows) if a.page_only else nulls(a.n, a.seed, a.jobs, rows_file=a.rows, max_samples=a.max_samples)
        )
        text = document(result, read_page(a.out) if a.out.exists() else "")
        write_result(a.out, text)
        print(text)
    except (ValueError, OSError) as error:  # rows of another run, a file that cannot be written
        p.error(str(error))


if __name__ == "__main__":
    main()
