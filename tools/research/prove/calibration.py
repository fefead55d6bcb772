"""`micron mismatch calibrate`: search the calibrate corpus, keep what a decision reads of each search, and learn."""

from __future__ import annotations

import json
import time
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

from firmware_py.recording.revision import git_revision
from sim_devices.physics.catalogue import EFFECTS
from sim_devices.physics.effect import Effect
from tools.mismatch.infer.constants import FILE, START, Constants
from tools.mismatch.infer.decide import stated
from tools.mismatch.infer.run import infer
from tools.mismatch.recording_load import load
from tools.output import write_text_atomic
from tools.research.prove.catalog import RIVALS
from tools.research.prove.corpus import CORPORA, answers_digest, digest_of, draw_case, generator_digest
from tools.research.prove.exact import reliability
from tools.research.prove.guests import installed
from tools.research.prove.harness import SHARED
from tools.research.prove.learn import Case, StatedName, cross_validated, learn, learn_sure, traits_of
from tools.research.prove.plans import SELDOM

SEARCHING = (*SHARED, *(f"tools/mismatch/infer/{name}.py" for name in ("count", "density", "search", "store")))
"""What the traits of a search depend on."""
LEAST_CASES = 15
"""Cases with fewer of which no constants are learned."""


def traits_file(folder: Path, samples: int) -> Path:
    """Return the file with the traits of searches by the present sources."""
    digest = f"{digest_of(*SEARCHING)[:12]}-{generator_digest()[:12]}"
    return folder / f"traits-{samples}-{digest}.jsonl"


def gather(
    folder: Path, numbers: Sequence[int], samples: int, minutes: float, progress: Callable[[str], None]
) -> tuple[dict[int, dict[str, Any]], int]:
    """(traits by number of the case, how many of ``numbers`` are still to be done); a stopped run goes on.

    Twins whose every run is a program (an FMU, the bench) are left out: one costs as much as ten others.
    """
    file, digest = traits_file(folder, samples), digest_of(*SEARCHING)
    done: dict[int, dict[str, Any]] = {}
    for line in file.read_text().splitlines() if file.exists() else ():
        try:
            row = json.loads(line)
        except json.JSONDecodeError:
            continue
        done[int(row["number"])] = row
    until = time.monotonic() + 60.0 * minutes
    corpus = CORPORA["calibrate"]
    with file.open("a") as rows:
        for number in numbers:
            if number in done or time.monotonic() > until:
                continue
            row: dict[str, Any] = {"number": number, "search": digest}
            began = time.process_time()
            drawn = draw_case(corpus, number, folder, samples)
            if drawn is not None and drawn.answer["twin"] not in SELDOM:
                with installed(drawn.recording):
                    row["traits"] = traits_of(infer(load(drawn.recording), START))
                    row["without"] = {
                        name: traits_of(infer(load(drawn.recording), START, effects=vocabulary_without(name)))
                        for name in beside(drawn.answer)
                    }
                row["answer"] = drawn.answer
            row["cpu_s"] = round(time.process_time() - began, 2)
            rows.write(json.dumps(row, default=float) + "\n")
            rows.flush()
            done[number] = row
            progress(f"{len(done)} kept  case {number}  {row['cpu_s']:.1f} s of CPU")
    return {n: done[n] for n in numbers if n in done}, sum(n not in done for n in numbers)


def names_of(answer: Mapping[str, Any]) -> list[str]:
    """Return the names of the effects of a case that have one."""
    return [e["name"] for e in answer["effects"] if e["name"] != "unknown"]


def beside(answer: Mapping[str, Any]) -> list[str]:
    """Return the names of a pair: without one of them in the vocabulary, the right answer is the other one alone.

    Real recordings are like this: a named effect stands beside physics that no name is for.
    """
    names = names_of(answer)
    return names if len(names) == 2 else []


def stated_names(case: Case, names: Sequence[StatedName]) -> list[StatedName]:
    """Return the names of a case that the map of "sure" is learned on.

    Where only noise is left the probability is that of a name among the vocabulary: no data tell a stand-in for physics
    without a name. A rest that is not noise may be such physics.
    """
    return [n for n in names if case.kind != "beside" or not n.known]


def vocabulary_without(name: str) -> list[Effect]:
    """Return the vocabulary without an effect and those that it is easily taken for."""
    gone = {name}.union(*(group for group in RIVALS if name in group))
    return [e for e in EFFECTS.values() if e.name not in gone]


def calibrate(
    folder: Path,
    cases: int,
    samples: int,
    minutes: float = float("inf"),
    *,
    partial: bool = False,
    progress: Callable[[str], None] = print,
) -> tuple[dict[str, Any] | None, int]:
    """(what belongs into ``constants.json``, cases that are still to be done).

    None instead of constants while cases are open, unless ``partial`` asks to learn from those that are done, and of
    fewer than ``LEAST_CASES``.
    """
    rows, left = gather(folder, range(cases), samples, minutes, progress)
    kept = {n: r for n, r in rows.items() if "traits" in r}
    if (left and not partial) or len(kept) < LEAST_CASES:
        return None, left
    known = [case for n, r in kept.items() for case in cases_of(n, r)]
    crossed = cross_validated(known)
    names = [stated_names(case, of) for case, of in zip(known, crossed.stated, strict=True)]
    constants = learn_sure(learn(known), [n for of in names for n in of])
    corpus = CORPORA["calibrate"]
    left_out = [p for k in range(len(names)) for p in _left_out(constants, names, k)]
    return {
        "format": 1,
        "constants": constants.to_json(),
        "provenance": {
            "learned": True,
            "revision": git_revision(),
            "generator": generator_digest(),
            "search": sorted({str(r["search"]) for r in kept.values()}),
            "seeds": [corpus.first, corpus.seed_of(cases - 1)],
            "numbers": list(kept),
            "cases": len(kept),
            "with_a_name_left_out": len(known) - len(kept),
            "without": sorted(SELDOM),
            "max_samples": samples,
            "corpus_sha256": answers_digest([r["answer"] for r in kept.values()]),
            "searched_with": START.to_json(),
            "date": time.strftime("%Y-%m-%d", time.gmtime()),
        },
        "cross_validated": {
            "cases": crossed.cases,
            "exactly_right": crossed.exactly_right,
            "mean_log_probability": crossed.mean_log_probability,
            "with_the_start": sum(c.right(START) for c in known),
            "true_set_was_searched": sum(any(s.names == c.names for s in c.sets) for c in known),
            "sure": reliability(left_out),
        },
    }, left  # fmt: skip


def _left_out(constants: Constants, names: Sequence[Sequence[StatedName]], k: int) -> list[tuple[float, float]]:
    """Names of case ``k`` with the map of "sure" that the others give."""
    others = learn_sure(constants, [n for i, of in enumerate(names) if i != k for n in of])
    return [(stated(n.sure, n.known, others), float(n.right)) for n in names[k]]


def cases_of(number: int, row: dict[str, Any]) -> list[Case]:
    """Return the case of a row of traits with its answer, and those with a name of a pair left out."""
    case, kind, names = f"c{number:05d}", row["answer"]["kind"], names_of(row["answer"])
    out = [Case.of(case, kind, names, row["traits"])]
    for left_out, traits in row["without"].items():
        out.append(Case.of(f"{case} without {left_out}", "beside", [n for n in names if n != left_out], traits))
    return out


def write_constants(body: dict[str, Any], file: Path = FILE) -> Path:
    """Write the constants where the engine reads them."""
    write_text_atomic(file, json.dumps(body, indent=1) + "\n")
    return file
