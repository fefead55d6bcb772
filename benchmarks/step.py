"""The whole step (sense, estimate, actuate): compiled against the same code in the plain interpreter."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from collections.abc import Iterator
from typing import Any

import numpy as np

from benchmarks.row import Row, cpu_us_per_call

CALLS = 2000


def frames(n: int) -> np.ndarray:
    """Scans of a trembling, slowly turning instrument, as counts."""
    from firmware_py.frame import COUNTS, LAYOUT, MAGNETOMETER_FRESH, MAGNETOMETER_RAW, TICK, TIME

    rows = np.zeros((n, LAYOUT.size))
    t = np.arange(n) / 1000.0
    rng = np.random.default_rng(1)
    level = np.array([12400, 11600, 17300, 11200, 12000, 17100, 16270, 4747])
    wave = 60.0 * np.sin(2 * np.pi * 10.0 * t)[:, None] * np.array([1, -1, 0.5, 1, 2, -2, 0, 0])
    rows[:, COUNTS : COUNTS + 8] = np.round(level + wave + 3.0 * rng.standard_normal((n, 8)))
    rows[:, TICK] = np.arange(n)
    rows[:, TIME] = t
    rows[::10, MAGNETOMETER_FRESH] = 1.0
    rows[:, MAGNETOMETER_RAW : MAGNETOMETER_RAW + 3] = (2.62, 2.39, 2.93)
    return rows


def _for_the_interpreter(chain: Any) -> Any:
    """The same chain on records whose fields are attributes, which the compiler does not need."""
    from firmware_py.chain import Chain
    from firmware_py.records import attributes

    for stage in (chain.sensing, chain.tremor, chain.actuation):
        stage.state, stage.params = attributes(stage.state), attributes(stage.params)
    return Chain(chain.sensing, chain.tremor, chain.actuation)


def measure() -> dict[str, float]:
    """CPU time of one step by call and in a batch, us."""
    from firmware_py.chain import default_chain, warm_up

    plain = os.environ.get("NUMBA_DISABLE_JIT") == "1"
    chain = default_chain()
    if plain:
        chain = _for_the_interpreter(chain)
    warm_up(chain)
    rows = frames(CALLS)
    chain.run(rows.copy())
    source = iter(rows)
    state = {"rows": source}

    def one() -> None:
        try:
            frame = next(state["rows"])
        except StopIteration:
            chain.reset()
            state["rows"] = iter(rows)
            frame = next(state["rows"])
        chain.step(frame)

    def batch() -> None:
        chain.reset()
        chain.run(rows)

    per_call = cpu_us_per_call(one, 200 if plain else CALLS, repeats=3 if plain else 7)
    return {"call_us": per_call, "batch_us": per_call if plain else cpu_us_per_call(batch, 1) / CALLS}


def rows() -> Iterator[Row]:
    ours = measure()
    environment = {**os.environ, "NUMBA_DISABLE_JIT": "1"}
    plain = json.loads(
        subprocess.run(
            [sys.executable, "-m", "benchmarks.step"], env=environment, capture_output=True, text=True, check=True
        ).stdout
    )
    for name, key, what in (
        ("step, one call a tick", "call_us", "thread CPU time of sense + estimate + actuate, called from Python"),
        ("step, in a batch", "batch_us", "the same inside compiled code, as replay and batch use it"),
    ):
        ratio = plain["call_us"] / ours[key]
        yield Row(
            name, what, ours[key], plain["call_us"], "same code, plain interpreter", "us", ratio, ">= 20 x", ratio >= 20
        )
    share = ours["call_us"] / 1000.0
    yield Row(
        "step, share of the tick", "CPU of one call against the 1 ms period", share, 1.0, "period", "ms", share,
        "<= 0.10", share <= 0.10,
    )  # fmt: skip


if __name__ == "__main__":
    print(json.dumps(measure()))
