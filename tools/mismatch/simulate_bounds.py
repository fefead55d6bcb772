"""Runs a twin for ``micron mismatch simulate`` and refuses one that diverges, with the sample at which it does."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np

from tools.errors import RecordingError
from tools.mismatch.recording import Array, Recording
from tools.mismatch.recording_channels import MOST_SIZE


def run_bounded(twin: Path, recording: Recording, run: Callable[[], dict[str, Array]]) -> dict[str, Array]:
    """Return the outputs (n,) of ``run``, in the units of the file. Messages name the file ``twin``.

    Raises RecordingError for a twin that cannot be run, or for outputs that are not one bounded number per sample.
    """
    with np.errstate(all="ignore"):
        try:
            found = run()
        except np.linalg.LinAlgError as error:
            raise RecordingError(f"{twin}: the twin cannot be run ({error}); check its parameters and units") from None
    for output, values in found.items():
        if values.shape != (recording.n,):
            raise RecordingError(
                f"{twin}: gives {output} with the shape {values.shape}; one number for each of {recording.n} samples is"
                " needed"
            )
        beyond = ~(np.abs(values) <= MOST_SIZE)
        if beyond.any():
            k = int(np.argmax(beyond))
            raise RecordingError(
                f"{twin}: the twin diverges: its {output} is {values[k]:.3g} {recording.file_unit[output]} at sample"
                f" {k} ({recording.t[k]:.4g} s); check its parameters, their signs and units"
            )
    return found
