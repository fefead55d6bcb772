"""Joins two recordings: fitted on the first, held out on the second, as benchmark data are supplied."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np

from tools.errors import RecordingError
from tools.mismatch.recording import Recording, Split
from tools.mismatch.recording_load import load


def joined(recording: Recording) -> tuple[Recording, bool]:
    """Join the recording with the other one that its ``[split]`` names, in front or behind; True if it names one.

    Raises RecordingError if the two do not have the same channels and rate.
    """
    split = recording.split
    if isinstance(split.test, Path):
        other = load(split.test)
        fit = split.fit if isinstance(split.fit, tuple) else (0, recording.n)
        test = other.split.test if isinstance(other.split.test, tuple) else (0, other.n)
        first, second = recording, other
    elif isinstance(split.fit, Path) and not split.fit.is_file():
        # the twin was fitted on several recordings, so this one is split by itself
        return replace(recording, split=Split()), False
    elif isinstance(split.fit, Path) and isinstance(split.test, tuple):
        other = load(split.fit)
        fit = other.split.fit if isinstance(other.split.fit, tuple) else (0, other.n)
        test = split.test
        first, second = other, recording
    else:
        return recording, False
    for kind in ("inputs", "outputs"):
        a, b = getattr(first, kind), getattr(second, kind)
        if set(a) != set(b):
            raise RecordingError(f"{recording.path}: [split] names {other.path}, which has other {kind}")
    if abs(first.dt / second.dt - 1) > 1e-6:
        raise RecordingError(f"{recording.path}: [split] names {other.path}, which was sampled at another rate")
    n = first.n + second.n
    initialization = split.initialization if split.initialization is not None else other.split.initialization
    test = (first.n + test[0], first.n + test[1])
    return (
        replace(
            recording,
            t=np.arange(n) * first.dt,
            dt=first.dt,
            inputs={s: np.concatenate([x, second.inputs[s]]) for s, x in first.inputs.items()},
            outputs={s: np.concatenate([x, second.outputs[s]]) for s, x in first.outputs.items()},
            context={
                s: np.concatenate([x, second.context[s]]) for s, x in first.context.items() if s in second.context
            },
            split=Split(fit, test, initialization),
            segments=(*first.segments, *(first.n + s for s in second.segments)),
        ),
        True,
    )
