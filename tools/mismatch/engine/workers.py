"""Runs independent pieces of work in parallel processes if they are long enough; the result is the same."""

from __future__ import annotations

import pickle
import threading
import uuid
import warnings
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from multiprocessing import parent_process
from typing import Any

import cloudpickle
import numpy as np
from joblib import Parallel, delayed
from joblib.parallel import get_active_backend
from numpy.typing import NDArray
from threadpoolctl import threadpool_limits

from hal.children import begin_as_worker
from tools.mismatch.engine.problem import Problem

LEAST_SAMPLES = 40_000  # samples times outputs above which processes save time for a few pieces
LEAST_WORK = 1_500_000  # samples times outputs times pieces above which processes save time for any number

_kept = threading.local()
"""The shared arguments that this thread of a worker unpacked last, and their key."""


@dataclass(frozen=True)
class Shared:
    """Describes the arguments at ``places`` that all pieces have in common.

    A worker receives and unpacks them once: a problem derives much from its recording.
    """

    places: tuple[int, ...]
    key: str


def quietly(function: Callable[..., Any], arguments: Sequence[Any]) -> Any:
    """Run a piece of work without warnings of diverging trials; the caller limits threads of linear algebra."""
    with np.errstate(all="ignore"):
        return function(*arguments)


def in_worker(function: Callable[..., Any], own: Sequence[Any], shared: Shared, packed: NDArray[np.uint8]) -> Any:
    """Run a piece of work in a worker, on one thread, from its ``own`` and the ``packed`` shared arguments."""
    if parent_process() is not None:
        begin_as_worker()
    if getattr(_kept, "key", None) != shared.key:
        _kept.arguments = None  # the old ones are freed before the new ones are made
        _kept.arguments, _kept.key = pickle.loads(packed.data), shared.key
    arguments = list(own)
    for i, a in zip(shared.places, _kept.arguments, strict=True):
        arguments.insert(i, a)
    with threadpool_limits(1):
        return quietly(function, arguments)


def spread(function: Callable[..., Any], work: Sequence[tuple[Any, ...]], jobs: int) -> Any:
    """Return a stream of the results of ``work``, in order, from processes or from the cluster of the context.

    joblib maps the packed arguments into its processes. A cluster gets them as the result of a task, which is run
    again if the worker that holds it is lost.
    """
    first = work[0]
    places = tuple(i for i, a in enumerate(first) if all(w[i] is a for w in work))
    shared = Shared(places, uuid.uuid4().hex)
    packed: Any = np.frombuffer(cloudpickle.dumps([first[i] for i in places]), np.uint8)
    client = getattr(get_active_backend()[0], "client", None)
    if client is not None:
        packed = client.submit(np.asarray, packed, key=f"mismatch-shared-{shared.key}")
    # loky ends a worker whose memory grew, and goes on with a new one: nothing for a person to act on
    warnings.filterwarnings("ignore", "A worker stopped while some jobs", UserWarning)
    own = ([a for i, a in enumerate(w) if i not in places] for w in work)
    return Parallel(n_jobs=jobs, return_as="generator")(delayed(in_worker)(function, o, shared, packed) for o in own)


def mapped(
    problem: Problem,
    function: Callable[..., Any],
    work: Sequence[tuple[Any, ...]],
    jobs: int,
    *,
    long: bool = True,
    tell: Callable[[int], None] | None = None,
) -> list[Any]:
    """Return ``function`` of every tuple of arguments in ``work``, in order.

    ``long``: a piece is a fit and not a screen; ``tell`` is called with the number of finished pieces.
    """
    size = problem.recording.n * len(problem.twin.outputs)
    pays = len(work) > 1 and (size * len(work) > LEAST_WORK or (long and size > LEAST_SAMPLES))
    stream = spread(function, work, jobs) if jobs > 1 and pays else (quietly(function, w) for w in work)
    found: list[Any] = []
    for result in stream:
        found.append(result)
        if tell:
            tell(len(found))
    return found
