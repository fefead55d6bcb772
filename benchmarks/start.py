"""Cold start: what is imported with ``hal``, and from the command to a warm firmware once the kernels are compiled."""

from __future__ import annotations

import subprocess
import sys
from collections.abc import Iterator

from benchmarks.row import Row

IMPORT = "import hal, time; print(time.process_time())"
FIRMWARE = """
import time
from benchmarks.step_input import stages
stages().warm_up()
print(time.process_time())
"""


def cpu_s(text: str, repeats: int = 3) -> float:
    """CPU from the start of a fresh interpreter."""
    command = [sys.executable, "-c", text]
    runs = [subprocess.run(command, capture_output=True, text=True, check=True) for _ in range(repeats)]
    return min(float(run.stdout.split()[-1]) for run in runs)


def rows() -> Iterator[Row]:
    hal = cpu_s(IMPORT)
    yield Row("start, import hal", "CPU, with the interpreter's start", hal, 0.2, "allowed", "s", hal / 0.2, "< 0.2 s",
              hal < 0.2, must=True)  # fmt: skip
    cpu_s(FIRMWARE, 1)
    warm = cpu_s(FIRMWARE)
    yield Row("start, firmware ready", "CPU to a warm step, kernels compiled before", warm, 3.0, "allowed", "s",
              warm / 3.0, "< 3 s", warm < 3.0, must=True)  # fmt: skip
