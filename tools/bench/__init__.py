"""Serves the bench page from a process of its own, which reads a running firmware and passes orders on to it.

What lives here: session with the firmware, viewers, recordings, jobs, the page's files in ``static``; ``open_run``.
What must not: anything that the loop could wait for.
"""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from xarray import Dataset


def open_run(path: str | Path) -> Dataset:
    """Return a recorded run (``micron run --record``) as an xarray Dataset: one variable (t,) per column with its unit,
    events on the dimension ``event``, and the texts of the run as attributes.

    Raises ``RecordingError`` for a file that is no recording, ``InputError`` without xarray (extra ``notebook``).
    """
    from firmware_py.recording.reader import Recording
    from tools.formats.netcdf import dataset

    return dataset(Recording(Path(path)))
