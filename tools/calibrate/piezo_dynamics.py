"""Models the linear part behind the hysteresis: dead time, amplifier lag and resonance of one stack.

A demand that is held for a tick moves the stack by a step through amplifier (first order) and mechanism (second
order); what is read at the sampling instants is the stroke's levels filtered with that step response. Recordings
that do not say that their drive was held only give a delay.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy.optimize import minimize
from scipy.signal import lfilter

from hal.arrays import Array, ComplexArray

MAX_LAG_S = 0.02
TAPS = 64
TREMOR_HZ = 10.0
LONG = 2048


@dataclass(frozen=True)
class Dynamics:
    """Dead time, first-order lag, resonance (0: none found) and its damping; ``slow_share`` of the stroke follows
    with ``slow_s`` more (domain walls do not jump with the field)."""

    delay_s: float = 0.0
    lag_s: float = 0.0
    resonance_hz: float = 0.0
    damping: float = 0.0
    slow_share: float = 0.0
    slow_s: float = 0.0

    def delay_at(self, hz: float = TREMOR_HZ) -> float:
        """Return the delay, in s, of a sinusoid of ``hz``."""
        return -float(np.angle(self.gain(np.array([hz]))[0])) / (2.0 * np.pi * hz)

    def mechanism(self, dt: float, held: bool) -> Dynamics:
        """The same without what sampling at ``dt`` and holding the drive as long adds to a delay."""
        if self.resonance_hz or not held:
            return self
        return Dynamics(delay_s=max(0.0, self.delay_s - 0.5 * dt))

    def gain(self, hz: Array) -> ComplexArray:
        """(n,) complex gain of the mechanism at ``hz``, 1 at rest."""
        s = 2j * np.pi * hz
        fast = np.exp(-s * self.delay_s) / (1.0 + s * self.lag_s)
        if self.resonance_hz:
            w = 2.0 * np.pi * self.resonance_hz
            fast = fast * (w * w / (s * s + 2.0 * self.damping * w * s + w * w))
        return fast * (1.0 - self.slow_share + self.slow_share / (1.0 + s * self.slow_s))

    def held_gain(self, hz: Array, tick_s: float) -> ComplexArray:
        """Return the complex gain (n,) from demands held for ``tick_s`` to the stroke, which moves the tip."""
        x = hz * tick_s
        return self.gain(hz) * np.sinc(x) * np.exp(-1j * np.pi * x)

    def sampled_gain(self, hz: Array, dt: float) -> ComplexArray:
        """(n,) the same as an instrument sees it that reads when a demand begins, at the same rate."""
        if not (self.resonance_hz or self.lag_s):
            return np.exp(-2j * np.pi * hz * self.delay_s)
        ticks: Array = np.arange(LONG, dtype=np.float64)
        weights = np.diff(self.step(ticks * dt), prepend=0.0)
        z = np.exp(-2j * np.pi * hz * dt)
        return np.asarray(np.polynomial.polynomial.polyval(z, weights), dtype=np.complex128)

    def sampled_delay_s(self, dt: float, hz: float = TREMOR_HZ) -> float:
        """Return the delay, in s, of a sinusoid of ``hz`` at the sampling instants, with a drive held for ``dt``."""
        return -float(np.angle(self.sampled_gain(np.array([hz]), dt)[0])) / (2.0 * np.pi * hz)

    def step(self, t: Array) -> Array:
        """Answer to a unit step at t = 0."""
        t = np.maximum(t - self.delay_s, 0.0)
        poles: list[complex] = [1.0 / max(self.lag_s, 1e-9)]
        if self.resonance_hz:
            w, z = 2.0 * np.pi * self.resonance_hz, self.damping
            poles += [complex(z * w, w * np.sqrt(1.0 - z * z)), complex(z * w, -w * np.sqrt(1.0 - z * z))]
        fast = _step_through(poles, t)
        if not self.slow_share:
            return fast
        return (1.0 - self.slow_share) * fast + self.slow_share * _step_through([*poles, 1.0 / self.slow_s], t)

    def response(self, dt: float, at_s: float | None = None) -> Array:
        """Return the weights (TAPS,) of the held levels at this tick, one, two, ... ticks ago, in a reading taken
        ``at_s`` after the tick began (default: at its beginning, when the new demand has no effect yet)."""
        edges = np.arange(TAPS + 1) * dt + (0.0 if at_s is None else at_s)
        steps = self.step(np.asarray(edges, dtype=np.float64))
        # the level of m ticks ago came m dt (+ at_s) ago and was replaced one dt later
        return np.diff(steps, prepend=0.0)[:TAPS]


def _step_through(poles: list[complex], t: Array) -> Array:
    """Step response of the product of p / (s + p), all poles different."""
    out = np.ones(len(t), dtype=np.complex128)
    for i, p in enumerate(poles):
        others = [q / (q - p) for j, q in enumerate(poles) if j != i]
        out -= np.exp(-p * t) * np.prod(others)
    return np.asarray(out.real, dtype=np.float64)


def fit_dynamics(levels: Sequence[Array], measured: Sequence[Array], dt: float, rows: Sequence[slice]) -> Dynamics:
    """Fit amplifier lag and resonance from the model's held stroke ``levels`` (n,) and ``measured`` (n,), both in
    um."""

    def misfit(p: Array) -> float:
        dynamics = _from_logs(p)
        # above the sampling rate a resonance is another one's alias
        if not (dynamics.lag_s < 5.0 * dt and dynamics.damping < 0.9 and 50.0 < dynamics.resonance_hz < 0.95 / dt):
            return 1e6
        if not (dynamics.slow_share < 0.9 and 1.1 * dynamics.lag_s < dynamics.slow_s < 20.0 * dt):
            return 1e6
        return _misfit(dynamics.response(dt), levels, measured, rows)

    best: Any = None
    for share in (0.3, 0.65):
        x0 = np.log([0.1 * dt, share / dt, 0.05, 0.3, 0.6 * dt])
        minimum: Any = minimize(misfit, x0, method="Nelder-Mead", options={"maxfev": 400, "xatol": 1e-3, "fatol": 1e-9})
        if best is None or minimum.fun < best.fun:
            best = minimum
    return _from_logs(best.x)


def _from_logs(p: Array) -> Dynamics:
    lag, hz, damping, share, slow = map(float, np.exp(np.minimum(p, 50.0)))
    return Dynamics(0.0, lag, hz, damping, share, slow)


def _misfit(response: Array, levels: Sequence[Array], measured: Sequence[Array], rows: Sequence[slice]) -> float:
    total = 0.0
    for x, z, use in zip(levels, measured, rows, strict=True):
        e = (z - np.asarray(lfilter(response, [1.0], x - x[0]), dtype=np.float64))[use]
        total += float(np.var(e))
    return total / len(levels)


def delayed(drive: Array, lag_s: float, dt: float) -> Array:
    """Return ``drive`` (n,) delayed by ``lag_s``, linear between samples."""
    t = np.arange(len(drive)) * dt
    return np.interp(t - lag_s, t, drive)
