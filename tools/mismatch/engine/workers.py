"""Runs independent pieces of work in parallel processes if they are long enough; the result is the same."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from multiprocessing import parent_process
from typing import Any

import numpy as np
from joblib import Parallel, delayed
from threadpoolctl import threadpool_limits

from hal.children import begin_as_worker
from tools.mismatch.engine.problem import Problem

LEAST_SAMPLES = 40_000  # samples times outputs above which processes save time for a few pieces
LEAST_WORK = 1_500_000  # samples times outputs times pieces above which processes save time for any number


def quietly(function: Callable[..., Any], arguments: tuple[Any, ...]) -> Any:
    """Run a piece of work without warnings of diverging trials.

    In a worker process the linear algebra is limited to one thread here. In the calling process the caller limits it,
    because the search for its libraries takes longer than many pieces.
    """
    if parent_process() is None:
        with np.errstate(all="ignore"):
            return function(*arguments)
    begin_as_worker()
    with np.errstate(all="ignore"), threadpool_limits(1):
        return function(*arguments)


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
    if jobs > 1 and pays:
        stream = Parallel(n_jobs=jobs, return_as="generator")(delayed(quietly)(function, w) for w in work)
    else:
        stream = (quietly(function, w) for w in work)
    found: list[Any] = []
    for result in stream:
        found.append(result)
        if tell:
            tell(len(found))
    return found
