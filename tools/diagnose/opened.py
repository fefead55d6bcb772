"""A bench opened for a diagnostic command: the same few lines for all of them."""

from __future__ import annotations

import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from hal.bench import OpenBench, load_bench, open_bench
from hal.clock import Pace


@contextmanager
def opened_bench(path: Path, *, pace: Pace | None) -> Iterator[OpenBench]:
    """Open every bus of the bench file ``path``. Raises ``HalError``."""
    with (
        tempfile.TemporaryDirectory(prefix="micron-") as folder,
        open_bench(load_bench(path), pace=pace, runtime_dir=Path(folder)) as bench,
    ):
        yield bench
