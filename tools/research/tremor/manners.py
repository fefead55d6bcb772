"""Tests methods on changes: onset, frequency jump, growing bias (Ang 2004, 5.2.2), on steady tones.

Each figure is a time (s) until what is left, rms over 0.25 s, stays below ``SETTLED`` of the tone; nan: never.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.signal import lfilter

from firmware_py.tremor.config import Method, TremorConfig
from firmware_py.tremor.estimator import Estimator
from hal.arrays import Array
from tools.research.tremor.cases import RATE_HZ, sensor_noise

SIZE_M = 25e-6
SETTLED = 0.3
SECONDS = 16.0
EVENT_S = 8.0


@dataclass(frozen=True)
class Manners:
    """``drift_share``: what is left under a bias that grows by 5 mg/s for 8 s, over what is left without it."""

    method: str
    onset_s: float
    jump_s: float
    drift_share: float
    drift_frequency_error_hz: float

    def as_dict(self) -> dict[str, str | float]:
        return asdict(self)


def manners(methods: Sequence[Method], config: TremorConfig | None = None) -> list[Manners]:
    """Onset at 8 s; a jump from 9 to 11 Hz at 8 s; a ramp of bias from 8 s on."""
    base = config or TremorConfig()
    n = round(SECONDS * RATE_HZ)
    t = np.arange(n) / RATE_HZ
    after = t >= EVENT_S
    steady = np.cos(2.0 * np.pi * 9.5 * t)
    jump = np.cos(2.0 * np.pi * np.cumsum(np.where(after, 11.0, 9.0)) / RATE_HZ)
    ramp = 0.005 * 9.81 * np.maximum(t - EVENT_S, 0.0)
    rows: list[Manners] = []
    for method in methods:
        chosen = base.model_copy(update={"method": method, "loop_delay_s": 0.002})
        onset, _ = _left(chosen, steady * after, np.zeros(n))
        jumped, _ = _left(chosen, jump, np.zeros(n))
        calm, _ = _left(chosen, steady, np.zeros(n))
        drifting, hz = _left(chosen, steady, ramp)
        last = slice(-round(4.0 * RATE_HZ), None)
        rows.append(
            Manners(
                method,
                _settles(onset, after),
                _settles(jumped, after),
                float(np.std(drifting[last]) / np.std(calm[last])),
                abs(hz - 9.5),
            )
        )
    return rows


def _left(config: TremorConfig, unit_path: Array, bias: Array) -> tuple[Array, float]:
    """Return the rest of a path of ``SIZE_M`` (n,), and the last frequency."""
    path = SIZE_M * unit_path
    acceleration = np.gradient(np.gradient(path)) * RATE_HZ**2 + bias
    keep = np.exp(-config.filter_cutoff_rad_s / RATE_HZ)
    seen = np.asarray(lfilter([0.5 * (1 - keep)] * 2, [1.0, -keep], acceleration))[:, None]
    estimate = Estimator(config, axes=1).run(seen + sensor_noise(seen.shape, 7))
    ticks = round(config.loop_delay_s * RATE_HZ)
    left = path.copy()
    left[ticks:] -= estimate.ahead_m[:-ticks, 0]
    return left, float(estimate.frequency_hz[-1, 0])


def _settles(left: Array, after: NDArray[np.bool_]) -> float:
    """Seconds from the event until the moving rms stays below the mark."""
    width = round(0.25 * RATE_HZ)
    power = np.convolve(left**2, np.full(width, 1.0 / width))[: len(left)]
    high = np.flatnonzero((np.sqrt(power) > SETTLED * SIZE_M / np.sqrt(2.0)) & after)
    if len(high) == 0:
        return 0.0
    return float("nan") if high[-1] >= len(left) - 2 else float((high[-1] + 1) / RATE_HZ - EVENT_S)
