"""Seals the end of a recording: no fit, choice or noise estimate reads it, and it is scored once after the decision."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from tools.mismatch.engine.exported import without_events
from tools.mismatch.engine.fit import Fit
from tools.mismatch.engine.pose import Posed, ranges_of
from tools.mismatch.engine.problem import Problem
from tools.mismatch.engine.report import Sealed
from tools.mismatch.engine.residual import residuals
from tools.mismatch.engine.score import held_rms
from tools.mismatch.engine.split import Split, cut, shot
from tools.mismatch.recording import Recording

SHARE = 0.1
"""Share of a recording that is sealed: its end, because a twin is used for later data."""
LEAST = 200
"""Least number of samples of a sealed part: they determine its rms to 5 %."""
PIECES = 8
"""Number of stretches of the sealed part, for a twin that restarts in every stretch."""


def seal(recording: Recording) -> tuple[Recording, str]:
    """Return the recording without its sealed end; or all of it, and why nothing is sealed (``Sealed.why``)."""
    if recording.parts:
        return recording, "several_recordings"
    if ranges_of(recording) is not None or recording.split.test is not None:
        return recording, "own_split"
    kept = recording.n - int(SHARE * recording.n)
    if recording.n - kept < LEAST:
        return recording, "short"
    return shortened(recording, kept), ""


def shortened(recording: Recording, samples: int) -> Recording:
    """Return the first ``samples`` of a recording."""
    return replace(
        recording,
        t=recording.t[:samples],
        inputs={s: x[:samples] for s, x in recording.inputs.items()},
        outputs={s: x[:samples] for s, x in recording.outputs.items()},
        context={s: x[:samples] for s, x in recording.context.items()},
        segments=recording.segments_of(0, samples),
    )


def score_sealed(whole: Recording, posed: Posed, base: Fit, fitted: Fit) -> Sealed:
    """Score the end of ``whole``, of which ``posed`` is the beginning.

    The run continues from the fitted part, with the recurring effects (no events).
    """
    problem, start = posed.problem, posed.problem.recording.n
    full = replace(
        problem.recording, t=whole.t, inputs=whole.inputs, outputs=whole.outputs, context=whole.context,
        segments=whole.segments,
    )  # fmt: skip
    tail = ((start, whole.n),)
    split = Split(whole.n, problem.split.fit, tail, cut(tail, 30), problem.split.fit_blocks)
    if problem.twin.restart:
        split = shot(split, problem.init, PIECES)
    onward = replace(problem, recording=full, split=split, hints=())
    return Sealed(tail[0], "", *(_rms(onward, f) for f in (posed.raw, base, without_events(problem, fitted))))


def _rms(problem: Problem, fitted: Fit) -> dict[str, float]:
    with np.errstate(all="ignore"):
        return held_rms(problem, replace(fitted, residual=residuals(problem, fitted.model, fitted.theta)))
