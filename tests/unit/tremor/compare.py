"""Residual tremor of both estimators on seeds that no setting was tuned on: ``python -m tests.unit.tremor.compare``.

Tuned on seeds 0-5; printed for seeds 100 and up, three axes at a time, at horizons of 4, 8 and 12 ms.
"""

from __future__ import annotations

from collections.abc import Iterable

import numba
import numpy as np

from firmware_py.frame import LAYOUT, STATUS, TICK, TIP_ACCELERATION, TREMOR_AHEAD
from firmware_py.tremor.config import METHODS, Method, TremorConfig
from firmware_py.tremor.stage import Tremor, estimate_kernel
from hal.arrays import Array
from tests.unit.tremor.synthetic import KINDS, RATE_HZ, make_record, residual_percent
from tools.research.tremor.baselines import BASELINES

HELD_OUT = range(100, 106)


@numba.njit
def _run(acceleration, frame, states, params, ahead):  # type: ignore[no-untyped-def]
    for k in range(len(acceleration)):
        frame[STATUS] = 0.0
        frame[TICK] = k
        for i in range(3):
            frame[TIP_ACCELERATION + i] = acceleration[k, i]
        estimate_kernel(frame, states, params)
        for i in range(3):
            ahead[k, i] = frame[TREMOR_AHEAD + i]


def predictions(config: TremorConfig, acceleration: Array) -> Array:
    """``tremor_ahead`` (n, 3) for tip accelerations (n, 3)."""
    tremor = Tremor(config)
    ahead = np.empty_like(acceleration)
    _run(np.ascontiguousarray(acceleration), LAYOUT.new_frame(), tremor.state, tremor.params, ahead)
    return ahead


def residuals(method: Method, delay_ms: int, kind: str, seeds: Iterable[int], seconds: float = 20.0) -> Array:
    """Residual percent of each seed."""
    config = TremorConfig(method=method, loop_delay_s=delay_ms * 1e-3)
    records = [make_record(seed, kind, seconds) for seed in seeds]
    scores: list[float] = []
    for start in range(0, len(records), 3):
        three = records[start : start + 3]
        ahead = predictions(config, np.stack([record.acceleration for record in three], axis=1))
        ticks = round(delay_ms * 1e-3 * RATE_HZ)
        scores += [residual_percent(record.tremor, ahead[:, i], ticks) for i, record in enumerate(three)]
    return np.array(scores)


def main() -> None:
    print(f"{'residual tremor, % rms in 8-12 Hz':36}" + "".join(f"{d:>8} ms" for d in (4, 8, 12)))
    for method in (*METHODS, *BASELINES):
        for kind in KINDS:
            row = [residuals(method, delay, kind, HELD_OUT) for delay in (4, 8, 12)]
            print(f"{method:12}{kind:24}" + "".join(f"{np.mean(r):5.1f} ±{np.std(r):4.1f}" for r in row))


if __name__ == "__main__":
    main()
