"""The blind self-proof: draw, seal, diagnose, open, score."""

from __future__ import annotations

import json
import sys
import tempfile
import time
from collections.abc import Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import asdict, dataclass, replace
from multiprocessing import get_context
from pathlib import Path
from typing import Any

import numpy as np

from firmware_py.recording.revision import git_revision
from hal.children import begin_as_worker
from tools.interrupt import keep_what_is_there, need_some
from tools.output import write_text_atomic
from tools.research.prove import draw, guests, seal
from tools.research.prove.disk import write
from tools.research.prove.plans import SELDOM
from tools.research.prove.plans import plans as drawn_plans
from tools.research.prove.runner import Diagnose, Done, diagnose_all, tool
from tools.research.prove.score import score, summary

MOST_SAMPLES = 8_000
"""Of a recording, unless told."""


@dataclass(frozen=True)
class ProofResult:
    """Rows per case and their summary; ``folder`` holds the recordings, answers and reports."""

    seed: int
    digest: str
    rows: tuple[dict[str, Any], ...]
    summary: dict[str, Any]
    seconds: float
    folder: Path
    max_samples: int = MOST_SAMPLES

    def to_json(self) -> dict[str, Any]:
        """Return what `micron mismatch prove --json` writes."""
        return {
            "format": 1,
            "seed": self.seed,
            "answers_sha256": self.digest,
            "revision": git_revision(),
            "date": time.strftime("%Y-%m-%d", time.gmtime()),
            "max_samples": self.max_samples,
            "seconds": round(self.seconds, 1),
            "folder": str(self.folder),
            "summary": self.summary,
            "cases": list(self.rows),
        }


def draw_one(job: tuple[int, int, draw.Plan, Path, int, str | None]) -> tuple[str, dict[str, Any], str] | None:
    """(name, answer, path) of one recording written below a folder; its noise is kept beside that folder. None when no
    scene shows the effect, or the extra ``fmu`` is missing for it. ``job``: seed, index, plan, folder, most samples,
    kind of noise (None: drawn)."""
    seed, index, plan, folder, max_samples, noise_kind = job
    if plan.twin == guests.FMU and not guests.fmu_possible():
        return None
    case = None
    # where no scene shows the effect at this severity, a larger one takes its place
    for severity in (plan.severity, *(s for s in draw.SEVERITIES if s > plan.severity)):
        try:
            case = draw.make([seed, index], replace(plan, severity=severity), max_samples, noise_kind)
            break
        except draw.NotVisible:
            continue
    if case is None:
        return None
    name = f"r{index:03d}"
    path = write(case, folder / name, f"recording {index}", np.random.default_rng([seed, index, 99]))
    seal.keep_noise(case, folder.parent / "sealed", name)
    return name, seal.answer(case), str(path)


def generate(
    seed: int,
    plans: Sequence[draw.Plan],
    folder: Path,
    *,
    jobs: int = 1,
    max_samples: int = MOST_SAMPLES,
    each_noise: Sequence[str] | None = None,
) -> tuple[dict[str, Path], dict[str, dict[str, Any]]]:
    """Write the recordings of these plans; (paths, answers). A plan that no scene shows is left out.

    ``each_noise`` fixes the kind of noise of each plan.
    """
    work = [(seed, i, p, folder, max_samples, each_noise[i] if each_noise else None) for i, p in enumerate(plans)]
    if jobs > 1:
        with ProcessPoolExecutor(jobs, mp_context=get_context("spawn"), initializer=begin_as_worker) as pool:
            done = list(pool.map(draw_one, work))
    else:
        done = [draw_one(w) for w in work]
    kept = [d for d in done if d is not None]
    return {n: Path(p) for n, _, p in kept}, {n: a for n, a, _ in kept}


def prove(
    cases: int = 40,
    seed: int | None = None,
    jobs: int = 2,
    folder: Path | None = None,
    *,
    only: tuple[str, str, float] | None = None,
    plans: Sequence[draw.Plan] | None = None,
    max_samples: int = MOST_SAMPLES,
    diagnose: Diagnose = tool,
    progress: Any = None,
) -> ProofResult:
    """Draw ``cases`` cases, seal the answers, run the tool on each, open the seal, score.

    ``seed`` None draws a fresh one from the clock; it is printed. ``folder`` keeps everything (a temporary folder
    otherwise); the same tool on the same answers goes on there where it was interrupted. ``only`` = (twin, effect,
    severity) restricts the single effects; ``plans`` takes the place of what would be drawn. ``progress`` is called
    with one line of text per event; standard error by default.
    """
    start = time.perf_counter()
    say = progress or (lambda text: print(text, file=sys.stderr, flush=True))
    seed = int(time.time_ns() % 1_000_000_007) if seed is None else seed
    folder = Path(tempfile.mkdtemp(prefix="micron-prove-")) if folder is None else folder
    asked = drawn_plans(seed, cases, only) if plans is None else plans
    say(f"seed {seed}, {len(asked)} cases, folder {folder}")
    of_fmus = sum(p.twin == guests.FMU for p in asked)
    if of_fmus and not guests.fmu_possible():
        say(f"{of_fmus} cases of an FMU are left out: they need FMPy (the extra 'fmu') and PythonFMU")
    paths, answers = generate(seed, asked, folder / "recordings", jobs=jobs, max_samples=max_samples)
    digest = seal.close(answers, folder / "sealed")
    missing = "" if len(answers) == len(asked) else f" ({len(asked) - len(answers)} could not be drawn)"
    say(f"{len(answers)} recordings written{missing}; answers sealed, sha256 {digest}")
    del answers
    kept = folder / "reports" / f"{digest[:16]}-{git_revision()[:16]}"
    kept.mkdir(parents=True, exist_ok=True)
    reports = {file.stem: Done(**json.loads(file.read_text())) for file in sorted(kept.glob("*.json"))}
    if reports:
        say(f"{len(reports)} of them diagnosed before")
    # the longest first: a process that begins one last would work alone
    left = sorted((k for k in paths if k not in reports), key=lambda k: SELDOM.get(asked[int(k[1:])].twin, 1.0))
    with keep_what_is_there():
        for done in diagnose_all({k: paths[k] for k in left}, jobs, diagnose):
            reports[done.name] = done
            write_text_atomic(kept / f"{done.name}.json", json.dumps(asdict(done), indent=1))
            say(f"{len(reports)}/{len(paths)}  {done.name}  {done.wall_s:.1f} s, {done.cpu_s:.1f} s of CPU")
    need_some(reports)
    opened = seal.opened(folder / "sealed", digest)
    rows: list[dict[str, Any]] = []
    for name in sorted(reports):
        done = reports[name]
        report = done.report
        spans = (report.get("fit") or {}).get("held_out_spans")
        oracle = seal.noise_on(folder / "sealed", name, spans) if spans else None
        rows.append(
            {
                "case": name,
                "path": str(paths[name]),
                "wall_s": round(done.wall_s, 2),
                "cpu_s": round(done.cpu_s, 2),
                **score(opened[name], report, oracle),
            }
        )
    return ProofResult(seed, digest, tuple(rows), summary(rows), time.perf_counter() - start, folder, max_samples)
