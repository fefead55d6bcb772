"""An emulated hand at other sampling rates than 1 kHz: what an estimator leaves beside the limit at that delay.

``python -m tests.unit.tremor.rates`` prints the table. The limit is the best causal linear filter of
the bank of that rate, fitted to the very record, at the very delay, with its noise; both are judged behind the filter
that lifts 8 to 12 Hz, as in ``tools.research.tremor.bound``.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.interpolate import CubicSpline
from scipy.signal import lfilter

from firmware_py.tremor.adaptive_design import design_adaptive, solve_scaled
from firmware_py.tremor.config import Method, TremorConfig
from firmware_py.tremor.estimator import Estimator
from hal.arrays import Array
from sim_devices.config import HandConfig
from sim_devices.plant.hand import NODE_S, SyntheticHand
from tools.research.tremor.bound import bank_features, lift

SKIP_S = 5.0
TO_COMMAND_S = 0.0016
"""From a scan to its command at the stroke; the middle of the hold, half a tick, comes on top (2.1 ms at 1 kHz)."""


@dataclass(frozen=True)
class RateFigures:
    """rms left behind the lifting filter, % of the tremor's."""

    rate_hz: float
    delay_ms: float
    left_percent: float
    limit_percent: float

    @property
    def ratio(self) -> float:
        return self.left_percent / self.limit_percent


def hand(seed: int, seconds: float, rate_hz: float, delay_s: float, config: TremorConfig) -> tuple[Array, Array]:
    """Samples (n, 3) m/s^2 at t behind filter and with noise, and the tremor (n, 3) m at t + ``delay_s``."""
    person = SyntheticHand(HandConfig(), seed)
    n = round((seconds + 0.1) / NODE_S)
    pose, parts = np.zeros((n, 18)), np.zeros((n, 6))
    person.fill(pose, parts)
    t_s = np.arange(1, n + 1) * NODE_S
    at = NODE_S + np.arange(round(seconds * rate_hz)) / rate_hz
    force, truth = CubicSpline(t_s, pose[:, 12:15])(at), CubicSpline(t_s, parts[:, 3:])(at + delay_s)
    rng, a = np.random.default_rng(seed + 1000), config.adaptive
    force = force + a.sensor_noise_m_s2_rtHz * np.sqrt(0.5 * rate_hz) * rng.standard_normal(force.shape)
    keep = np.exp(-config.filter_cutoff_rad_s / rate_hz)
    behind = np.asarray(lfilter([0.5 * (1.0 - keep)] * 2, [1.0, -keep], force, axis=0))
    return behind + a.reading_noise_m_s2 * rng.standard_normal(force.shape), truth


def figures(rate_hz: float, seed: int, seconds: float = 20.0, designed_hz: float | None = None) -> RateFigures:
    """The default estimator designed for ``rate_hz``, or for ``designed_hz``, in one hand."""
    return left_by(TremorConfig().method, rate_hz, seed, seconds, designed_hz)


def left_by(method: Method, rate_hz: float, seed: int, seconds: float, designed_hz: float | None) -> RateFigures:
    delay_s = TO_COMMAND_S + 0.5 / rate_hz
    config = TremorConfig(tick_hz=rate_hz, loop_delay_s=delay_s, method=method)
    samples, truth = hand(seed, seconds, rate_hz, delay_s, config)
    used = config if designed_hz is None else config.model_copy(update={"tick_hz": designed_hz})
    ahead = Estimator(used).run(samples).ahead_m
    design, scored = design_adaptive(config), slice(round(SKIP_S * rate_hz), -round(rate_hz))
    limit = np.empty_like(truth)
    wanted = lift(truth, design)
    for i in range(3):
        features = bank_features(samples[:, i], design)
        rows = lift(features, design)[scored]
        limit[:, i] = features @ solve_scaled(rows.T @ rows, (rows.T @ wanted[scored, i])[None, :])[0]

    def percent(estimate: Array) -> float:
        left = lift(truth - estimate, design)[scored]
        return float(100.0 * np.sqrt(np.sum(left**2) / np.sum(wanted[scored] ** 2)))

    return RateFigures(rate_hz, 1e3 * delay_s, percent(ahead), percent(limit))


def main() -> None:
    print("| rate (Hz) | delay (ms) | left (%) | limit at that delay (%) | left / limit |")
    print("|---:|---:|---:|---:|---:|")
    for rate_hz in (250.0, 500.0, 1000.0, 2000.0):
        rows = [figures(rate_hz, seed, 30.0) for seed in (101, 102, 103)]
        left, limit = (float(np.mean(v)) for v in zip(*((r.left_percent, r.limit_percent) for r in rows), strict=True))
        print(f"| {rate_hz:g} | {rows[0].delay_ms:.2f} | {left:.1f} | {limit:.1f} | {left / limit:.2f} |")


if __name__ == "__main__":
    main()
