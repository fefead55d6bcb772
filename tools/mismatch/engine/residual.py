"""Computes residuals on a problem's view, and replaces samples that an effect claims as events."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from hal.arrays import Array
from tools.mismatch.engine.problem import Problem
from tools.mismatch.simulate import Model


def residuals(problem: Problem, model: Model, theta: Array, outputs: Sequence[str] | None = None) -> dict[str, Array]:
    """Return measured minus simulated on the problem's view (of ``outputs``, all if None); non-finite becomes large.

    Samples that an effect claims as events are replaced by earlier usual samples, so that every mean square is over
    usual samples. The nearest ones are not used, because the choice of an event's end makes them quiet.
    """
    found = model.residual(problem.view, theta, outputs)
    out: dict[str, Array] = {}
    for o in outputs or problem.twin.outputs:
        r = np.nan_to_num(found[o], nan=1e12, posinf=1e12, neginf=-1e12)
        excused = model.excused(problem.view, o)
        if excused.any() and not excused.all():
            source = stand_ins(excused)
            r = r[source]
        out[o] = r
    return out


STAND_OFF = 8  # number of samples between an event and its replacement


def stand_ins(excused: NDArray[np.bool_]) -> NDArray[np.int64]:
    """Return the row that replaces each row (n,): usual rows are kept.

    The k-th row of an event is replaced by the k-th usual one before it, from ``STAND_OFF`` back; at the start of the
    record by the first ones after it. At least one row must be usual.
    """
    usual = np.flatnonzero(~excused)
    source = np.arange(excused.size)
    rows = np.flatnonzero(excused)
    place = np.searchsorted(usual, rows)  # usual rows before the event
    first = np.diff(rows, prepend=-2) > 1
    number = np.arange(rows.size) - np.maximum.accumulate(np.where(first, np.arange(rows.size), 0))
    back = place - STAND_OFF - 1 - number
    source[rows] = usual[np.where(back >= 0, back, (place + STAND_OFF + number) % usual.size)]
    return source
