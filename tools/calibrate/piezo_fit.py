"""Holds the result of the identification of one piezo stack: its model, its prediction error and its limits."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from firmware_py.actuation.config import StackConfig
from tools.calibrate.piezo_dynamics import Dynamics
from tools.calibrate.piezo_feedforward import Answers


@dataclass(frozen=True)
class PiezoFit:
    """Holds one identified stack. Errors are in um. ``held_out``: of recordings that the fit had not seen (leave one
    out), or of the last 30 % of a single one; ``unseen`` by recording, ``parts`` what was tried and what it left."""

    stack: StackConfig
    dynamics: Dynamics
    lag_s: float
    rms_um: float
    held_out_rms_um: float
    held_out_max_um: float
    linear_rms_um: float
    range_um: float
    top_rate_um_s: float
    unseen_um: dict[str, float]
    parts: tuple[tuple[str, float, bool], ...]
    warnings: tuple[str, ...]
    others: tuple[StackConfig, ...]
    """Models that lack one recording each."""
    tick_hz: float
    low_V: float
    high_V: float
    span_um: tuple[float, float]
    answer: Answers
    """Lag and resonance that the taps undo, from steps if there were any, with the delay of the model."""

    @property
    def neutral_V(self) -> float:
        """Middle of the drive."""
        return 0.5 * (self.low_V + self.high_V)

    @property
    def singular_um_s(self) -> float:
        """Rate at which a slope of the model reaches zero: beyond, it has no inverse. Infinite when none falls."""
        sums = np.cumsum(self.stack.play_weights_um_per_V)
        law = np.array(self.stack.slope_per_rate_s_per_V or (0.0,) * len(sums))
        high = np.array(self.stack.rate_high_um_per_s or (np.inf,) * len(sums))
        falling = law < 0.0
        at = sums[falling] / -law[falling]
        at = at[at < high[falling]]
        return float(at.min()) if len(at) else float("inf")
