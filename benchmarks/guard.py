"""Regression guard: thread CPU of compiled work against a fixed compiled kernel, in one process, taken in turns.

``guard.json`` keeps the ratios of the last time somebody looked; ``tests/perf`` holds them to ``MARGIN``. The least of
many short measurements is what neighbours cannot lower. ``python -m benchmarks.guard`` writes the file.
"""

from __future__ import annotations

import json
from collections.abc import Callable
from math import cos, sin, sqrt
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from benchmarks import step_input
from benchmarks.row import side_by_side
from firmware_py.sensing.fusion import Fusion, FusionConfig
from hal.compiled import kernel
from tools.noise.allan import allan_curve

FILE = Path(__file__).with_name("guard.json")
MARGIN = 1.6
"""A step that lost its compiled chain, or allocates, is far beyond; processors differ by less."""
TICKS = 1000
SAMPLES = 2000
POINTS = 40_000
PASSES = 4000
REPEATS = 15
ATTEMPTS = 4


@kernel
def reference(matrix: NDArray[np.float64], vector: NDArray[np.float64], passes: int) -> float:
    """A fixed amount of what the step is made of: rank-one updates, sine and cosine, a root and a division."""
    total = 0.0
    for n in range(passes):
        c, s = cos(0.001 * n), sin(0.001 * n)
        for i in range(len(vector)):
            own = c * vector[i]
            for j in range(len(vector)):
                matrix[i, j] = 0.999 * matrix[i, j] + own * vector[j]
        total += s / sqrt(1.0 + matrix[0, 0])
    return total


def jobs() -> dict[str, Callable[[], object]]:
    """What is guarded; each does the same work every time it is called."""
    stages, inputs = step_input.settled(TICKS)
    kept = [record.copy() for record in stages.arguments]
    frame, rows = stages.frame.copy(), inputs.copy()

    def step() -> None:
        for record, before in zip(stages.arguments, kept, strict=True):
            record[:] = before
        stages.frame[:] = frame
        rows[:] = inputs
        stages.run(rows)

    rng = np.random.default_rng(1)
    signals = rng.standard_normal((3, SAMPLES, 3)) + np.array([0.0, 0.0, 9.81])
    signal = rng.standard_normal(POINTS)
    fusion = Fusion(FusionConfig(method="mahony"), 286.0)  # a plug-in: finding it is not what is guarded

    def attitude() -> None:
        fusion.restart()
        fusion.run(*signals)

    return {
        "step": step,
        "attitude": attitude,
        "allan": lambda: allan_curve(signal, 1000.0),
    }


def measure() -> dict[str, float]:
    """CPU of each job over that of the reference."""
    matrix, vector = np.zeros((13, 13)), np.linspace(-1.0, 1.0, 13)
    work = jobs()
    functions = [lambda: reference(matrix, vector, PASSES), *work.values()]
    for function in functions:
        function()
    base, *times = side_by_side(functions, repeats=REPEATS)
    return {name: float(t / base) for name, t in zip(work, times, strict=True)}


def slower() -> dict[str, tuple[float, float]]:
    """Jobs beyond the margin in every attempt: (least ratio found, stored ratio)."""
    stored: dict[str, float] = json.loads(FILE.read_text())
    least: dict[str, float] = {}
    for _ in range(ATTEMPTS):
        for name, ratio in measure().items():
            least[name] = min(ratio, least.get(name, np.inf))
        late = {name: (least[name], stored[name]) for name in stored if least[name] > MARGIN * stored[name]}
        if not late:
            return {}
    return late


if __name__ == "__main__":
    found = [measure() for _ in range(3)]
    FILE.write_text(json.dumps({name: round(min(f[name] for f in found), 4) for name in found[0]}, indent=2) + "\n")
    print(FILE.read_text())
