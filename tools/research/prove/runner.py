"""Runs the tool under test on recordings, in processes. The only place that touches it."""

from __future__ import annotations

import json
import time
import traceback
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from dataclasses import dataclass
from multiprocessing import get_context
from pathlib import Path
from typing import Any, TypeVar

from hal.children import begin_as_worker, use_one_thread
from tools.research.prove.guests import installed

Diagnose = Callable[[Path], dict[str, Any]]
A = TypeVar("A")
B = TypeVar("B")


def tool(path: Path) -> dict[str, Any]:
    """`micron mismatch diagnose` on one recording, in this process: the JSON report."""
    from tools.mismatch.infer import diagnose
    from tools.mismatch.recording_load import load

    return as_plain(diagnose(load(path), jobs=1))  # workers of a worker may keep it from ending


def as_plain(report: Any) -> dict[str, Any]:
    """The report as parsed JSON, whatever object carries it."""
    if isinstance(report, dict):
        return json.loads(json.dumps(report, default=float))
    for name in ("to_json", "as_dict", "to_dict", "json", "model_dump"):
        if hasattr(report, name):
            out = getattr(report, name)()
            return json.loads(out) if isinstance(out, str) else json.loads(json.dumps(out, default=float))
    raise TypeError(f"cannot read a report of type {type(report).__name__}")


@dataclass(frozen=True)
class Done:
    """Holds a diagnosis: its JSON report, wall time, and CPU time of its process."""

    name: str
    report: dict[str, Any]
    wall_s: float
    cpu_s: float


def timed(job: tuple[str, Path, Diagnose]) -> Done:
    """Run and time a diagnosis; an exception becomes a report with the verdict 'error'."""
    name, path, diagnose = job
    wall, cpu = time.perf_counter(), time.process_time()
    try:
        with installed(path):
            report = diagnose(path)
    except Exception as e:  # a crash of the tool is a result to be counted, not ours to raise
        last = traceback.extract_tb(e.__traceback__)[-1]
        report = {
            "verdict": "error",
            "error": f"{type(e).__name__}: {e} ({Path(last.filename).name}:{last.lineno})",
        }
    return Done(name, report, time.perf_counter() - wall, time.process_time() - cpu)


def diagnose_all(paths: dict[str, Path], jobs: int, diagnose: Diagnose = tool) -> Iterator[Done]:
    """Diagnoses as they finish; ``jobs`` processes, in this one if 1."""
    yield from in_processes(timed, [(k, p, diagnose) for k, p in paths.items()], jobs)


def in_processes(function: Callable[[A], B], items: Sequence[A], jobs: int) -> Iterator[B]:
    """Results as they finish, from ``jobs`` processes with one thread each; in this process if 1."""
    if jobs <= 1 or len(items) < 2:
        yield from map(function, items)
        return
    use_one_thread()
    with ProcessPoolExecutor(
        min(jobs, len(items)), mp_context=get_context("spawn"), initializer=begin_as_worker
    ) as pool:
        for done in as_completed([pool.submit(function, item) for item in items]):
            yield done.result()
