"""Reads what each output of a twin shows at zero: a sensor's zero is no physics that is missing.

Without it a constant would be named as a step or a curve.
"""

from __future__ import annotations

import math
from collections.abc import Collection, Mapping

import numpy as np

from tools.errors import RecordingError
from tools.mismatch.recording import Recording

OFFSETS = "offsets"
"""Key of ``[twin.parameters]``."""


def offset_name(output: str) -> str:
    """Return the name of the offset of an output among the parameters."""
    return f"{output}_offset"


def read_offsets(recording: Recording, others: Collection[str]) -> dict[str, float]:
    """Return the offset of every output, by the output; none where one of ``others`` has its name.

    An engineer who has a parameter of that name has the offset in the simulation. Raises RecordingError.
    """
    own = [o for o in recording.outputs if offset_name(o) not in others]
    given = recording.twin.parameters.get(OFFSETS, {})
    if not isinstance(given, Mapping) or any(o not in own or not _number(v) for o, v in given.items()):
        raise RecordingError(
            f"{recording.path}: [twin] {OFFSETS} must give a number for an output ({', '.join(own)}), got {given!r}"
        )
    return {o: float(given.get(o, 0.0)) for o in own}


def offset_scale(recording: Recording, output: str) -> float:
    """Return a typical step of the offset of an output.

    It is small beside those of the engineer's own numbers: a constant that one of them makes as well is left to it.
    """
    return 1e-4 * float(np.ptp(recording.outputs[output])) or 1e-3


def _number(value: object) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool) and math.isfinite(value)
