"""Taps that undo amplifier lag and resonance of each stack, and the preview that they need (Ang 2004, 7.5).

The tremor predictor has one horizon, so all stacks get the same preview: the lag of the slowest. More is taken only
when that pays, because a tremor that is predicted further ahead is predicted worse.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from firmware_py.actuation.feedforward import Answer, design_feedforward, tracking_gain
from hal.arrays import Array, ComplexArray
from tools.calibrate.piezo_dynamics import Dynamics

TAPS = 6
BAND_HZ = 40.0
ENOUGH = 0.002  # largest error up to BAND_HZ, as a fraction of the amplitude
MORE_S = (0.0, 0.5e-3, 1.0e-3)


@dataclass(frozen=True)
class Feedforward:
    """Holds ``taps`` of each stack, newest first, and ``preview_s`` from the demand to the stroke that it is for.
    ``left`` and ``without``: largest error at 1 to 40 Hz, share of the amplitude, with the taps and with the preview
    alone; ``peak``: largest gain of the taps at any frequency."""

    taps: tuple[tuple[float, ...], ...]
    preview_s: float
    left: tuple[float, ...]
    without: tuple[float, ...]
    peak: tuple[float, ...]


def design(answers: Sequence[Answer], delays_s: Sequence[float], dt: float) -> Feedforward:
    """Taps for stacks that answer a held demand by ``answers``; ``delays_s``: their lag in slow motion."""
    hz: Array = np.linspace(1.0, BAND_HZ, 40)
    everywhere: Array = np.linspace(0.0, 0.5 / dt, 200)
    best: Feedforward | None = None
    for more_s in MORE_S:
        # a whole number of 10 us reads better and costs nothing
        preview_s = round(max(delays_s) + more_s, 5)
        taps = [design_feedforward(answer, dt, preview_s, TAPS, BAND_HZ) for answer in answers]
        candidate = Feedforward(
            tuple(tuple(map(float, t)) for t in taps),
            preview_s,
            tuple(_worst(t, a, dt, preview_s, hz) for t, a in zip(taps, answers, strict=True)),
            tuple(_worst(np.ones(1), a, dt, round(max(delays_s), 5), hz) for a in answers),
            tuple(float(np.max(np.abs(np.polyval(t[::-1], np.exp(-2j * np.pi * everywhere * dt))))) for t in taps),
        )
        if best is None or max(candidate.left) < 0.5 * max(best.left):
            best = candidate
        if max(best.left) < ENOUGH:
            break
    assert best is not None
    return best


def _worst(taps: Array, answer: Answer, dt: float, preview_s: float, hz: Array) -> float:
    return float(np.max(np.abs(tracking_gain(taps, answer, dt, preview_s, hz) - 1.0)))


@dataclass(frozen=True)
class Answers:
    """Holds the response of one stack to a held demand: its ``mechanism``, and ``sampled``, the response that
    recordings of ``dt`` show. Both come later by ``more_s``."""

    mechanism: Dynamics
    sampled: Dynamics
    more_s: float
    dt: float

    def late(self, hz: Array) -> ComplexArray:
        return np.exp(-2j * np.pi * hz * self.more_s)

    def tip(self, tick_s: float) -> Answer:
        """Return the response to demands that are held for ``tick_s``."""
        return lambda hz: self.late(hz) * self.mechanism.held_gain(hz, tick_s)

    def instrument(self) -> Answer:
        """The same as read just before the next demand."""
        return lambda hz: self.late(hz) * self.sampled.sampled_gain(hz, self.dt)


def for_tip(stacks: Sequence[Answers], tick_s: float) -> Feedforward:
    """Return the feedforward for the firmware, whose demands are held for ``tick_s``."""
    delays = [0.5 * tick_s + s.mechanism.delay_at() + s.more_s for s in stacks]
    return design([s.tip(tick_s) for s in stacks], delays, tick_s)


def for_instrument(stacks: Sequence[Answers]) -> Feedforward:
    """Return the feedforward for a synchronous interferometer of the recordings' rate."""
    dt = stacks[0].dt
    return design([s.instrument() for s in stacks], [s.sampled.sampled_delay_s(dt) + s.more_s for s in stacks], dt)
