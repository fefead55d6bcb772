"""Runs the engine over a corpus and keeps a row per case on disk, so that a stopped run goes on where it was."""

from __future__ import annotations

import json
import tempfile
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from firmware_py.recording.revision import git_revision
from tools.research.prove.corpus import CORPORA, Corpus, Name, digest_of, draw_case, first_block, generator_digest
from tools.research.prove.exact import score_exactly as score
from tools.research.prove.exact import summarise
from tools.research.prove.runner import Diagnose, in_processes, timed, tool

SHARED = ("tools/mismatch/engine", "tools/mismatch/twins", "sim_devices/physics")
SOURCES = (*SHARED, "tools/mismatch/infer")
"""The sources that a diagnosis depends on. A row that was made with other sources is made again."""


@dataclass(frozen=True)
class Run:
    """Describes a run: ``cases`` of a corpus from number ``first`` on, at ``max_samples``.

    No case starts after ``minutes``.
    """

    corpus: Name
    cases: int
    max_samples: int
    minutes: float = float("inf")
    jobs: int = 1
    first: int = 0


@dataclass(frozen=True)
class Result:
    """``rows`` in the order of the cases (of an open corpus; empty otherwise), ``summary``, and how many of the cases
    could not be drawn (``left_out``) or are still to be done (``open_cases``)."""

    run: Run
    rows: tuple[dict[str, Any], ...]
    summary: dict[str, Any]
    left_out: int
    open_cases: int
    digest: str

    def to_json(self) -> dict[str, Any]:
        """Return what ``micron mismatch prove --corpus ... --json`` writes."""
        r = self.run
        return {
            "format": 1, "corpus": r.corpus, "cases_asked": r.cases, "max_samples": r.max_samples,
            "revision": git_revision(), "engine_digest": self.digest, "date": time.strftime("%Y-%m-%d", time.gmtime()),
            "left_out": self.left_out, "open_cases": self.open_cases, "summary": self.summary, "rows": list(self.rows),
        }  # fmt: skip


@dataclass(frozen=True)
class _Job:
    corpus: Corpus
    number: int
    start: int
    folder: Path
    max_samples: int
    diagnose: Diagnose


def _one(job: _Job) -> dict[str, Any]:
    """The row of one case; ``{"case": ..., "left_out": True}`` when it cannot be drawn."""
    case = f"c{job.number:05d}"
    if job.corpus.open:
        return _scored(job, job.folder, case)
    with tempfile.TemporaryDirectory(prefix="micron-sealed-") as tmp:  # nobody looks at a sealed recording
        return _scored(job, Path(tmp), case)


def _scored(job: _Job, folder: Path, case: str) -> dict[str, Any]:
    drawn = draw_case(job.corpus, job.number, folder, job.max_samples, job.start)
    if drawn is None:
        return {"case": case, "left_out": True}
    done = timed((case, drawn.recording, job.diagnose))
    row = {"case": case, **score(drawn.answer, done.report), "cpu_s": round(done.cpu_s, 2)}
    if job.corpus.open:
        return {**row, "report": _essence(done.report)}
    for key in ("true", "said", "form", "intervals"):
        row[key] = [{"covered": i["covered"]} for i in row[key]] if key == "intervals" else []
    return row


def _essence(report: dict[str, Any]) -> dict[str, Any]:
    """Return the parts of a report that scores use, kept so that a change of the scores costs no diagnosis."""
    kept = {k: report[k] for k in ("verdict", "meaning", "equivalent", "seconds", "error") if k in report}
    kept["physics"] = [
        {k: p[k] for k in ("name", "output", "confidence", "parameters")} for p in report.get("physics") or []
    ]
    return kept


def _scored_again(row: dict[str, Any], corpus: Corpus, folder: Path, run: Run, start: int) -> dict[str, Any]:
    """The row with its scores as they are computed today, from the report that it keeps."""
    drawn = draw_case(corpus, int(row["case"][1:]), folder, run.max_samples, start) if "report" in row else None
    return row if drawn is None else {**row, **score(drawn.answer, row["report"])}


def run_corpus(
    run: Run, folder: Path, *, diagnose: Diagnose | None = None, progress: Callable[[str], None] = print
) -> Result:
    """Diagnose what ``folder`` holds no row of yet; score; summarise all rows. Raises ValueError on a bad ``run``.

    Rows are appended to ``<folder>/rows/<corpus>-<samples>.jsonl``; only those of the present sources count.
    """
    if run.cases < 1 or run.max_samples < 500:
        raise ValueError("a corpus is run on at least one case of at least 500 samples")
    corpus = CORPORA[run.corpus]
    revision = git_revision()
    if not corpus.open and revision.endswith("-dirty"):
        raise ValueError("the sealed corpus is drawn from a commit's hash; commit first")
    start = first_block(corpus, revision)
    digest = f"{digest_of(*SOURCES)[:16]}-{generator_digest()[:16]}-{start}"
    file = folder / "rows" / f"{run.corpus}-{run.max_samples}.jsonl"
    file.parent.mkdir(parents=True, exist_ok=True)
    done = {r["case"]: _scored_again(r, corpus, folder, run, start) for r in read_rows(file, digest)}
    if not corpus.open:
        _remember_draw(folder, run, revision)
    call = diagnose or tool
    numbers = range(run.first, run.first + run.cases)
    left = [n for n in numbers if f"c{n:05d}" not in done]
    until = time.monotonic() + 60.0 * run.minutes
    in_time: Iterator[int] = (n for n in left if time.monotonic() < until)
    if run.jobs > 1:
        # processes take their work at once, so the time is looked at once per round
        rounds = [left[i : i + 4 * run.jobs] for i in range(0, len(left), 4 * run.jobs)]
        chunks = (chunk for chunk in rounds if time.monotonic() < until)
    else:
        chunks = ([n] for n in in_time)
    with file.open("a") as rows:
        for chunk in chunks:
            work = [_Job(corpus, n, start, folder, run.max_samples, call) for n in chunk]
            for row in in_processes(_one, work, run.jobs):
                rows.write(json.dumps({**row, "digest": digest}) + "\n")
                rows.flush()
                done[row["case"]] = row
                progress(f"{len(done)} rows  {row['case']}  {row.get('cpu_s', 0.0):.1f} s of CPU")
    wanted = [done[c] for n in numbers if (c := f"c{n:05d}") in done]
    scored = [{k: v for k, v in r.items() if k != "report"} for r in wanted if not r.get("left_out")]
    open_rows = tuple(scored) if corpus.open else ()
    return Result(run, open_rows, summarise(scored), len(wanted) - len(scored), run.cases - len(wanted), digest)


def read_rows(file: Path, digest: str | None = None) -> list[dict[str, Any]]:
    """Rows of a file; of one ``digest`` alone where it is given. A line that was cut short is left out."""
    out: list[dict[str, Any]] = []
    for line in file.read_text().splitlines() if file.exists() else ():
        try:
            row = json.loads(line)
        except json.JSONDecodeError:
            continue
        if digest is None or row.get("digest") == digest:
            out.append(row)
    return out


def _remember_draw(folder: Path, run: Run, revision: str) -> None:
    """Count how often the sealed corpus was drawn: its page says so."""
    entry = {"revision": revision, "cases": run.cases, "date": time.strftime("%Y-%m-%d")}
    with (folder / "sealed-draws.jsonl").open("a") as file:
        file.write(json.dumps(entry) + "\n")
