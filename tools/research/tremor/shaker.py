"""The shaker recordings and the wrist recording against what is known of them: the figures of inspection."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from hal.arrays import Array
from tools.research.tremor.inspect import Inspection, Rule, inspect
from tools.research.tremor.signal import TremorSignal

SHAKER_RULE = Rule(band_hz=(1.5, 15.0))  # the shaker goes down to 2 Hz
FOLDS = 10


@dataclass(frozen=True)
class Shaker:
    """``error_hz``: found minus driven, by amplitude; ``covered``: 95 % intervals that hold the drive frequency.

    ``as_stated_hz``: the largest error, medium and high, if the stated rate were believed.
    """

    error_hz: dict[str, Array]
    covered: float
    as_stated_hz: float
    clock: str

    @property
    def worst_hz(self) -> float:
        """Largest error at medium and high amplitude."""
        return float(max(np.max(np.abs(self.error_hz[a])) for a in ("med", "high")))


@dataclass(frozen=True)
class Wrist:
    """Windows of the wrist recording against the reference: with the fixed rule, and with the share's limit chosen on
    nine tenths of the recording and judged on the tenth left out."""

    sensitivity: float
    specificity: float
    held_out_sensitivity: float
    held_out_specificity: float
    windows: int
    with_tremor: int
    frequency_error_hz: Array
    share_to_be_90: tuple[float, float]

    @property
    def frequency_near(self) -> float:
        """Part of the reference's tremor windows whose peak is within 0.35 Hz."""
        return float(np.mean(np.abs(self.frequency_error_hz) <= 0.35))


def shaker_figures(signals: list[TremorSignal]) -> Shaker:
    """Return all driven recordings; each one's clock rate comes from the set as a whole (one number for 44)."""
    error: dict[str, list[float]] = {"low": [], "med": [], "high": []}
    covered: list[bool] = []
    stated = 0.0
    clock = ""
    for s in signals:
        drive = s.reference.drive_hz
        if drive is None:
            continue
        found = inspect(s, SHAKER_RULE)
        error[s.reference.amplitude].append(found.peak_hz - drive)
        covered.append(found.low_hz <= drive <= found.high_hz)
        clock = s.notes[0] if s.notes else clock
        if s.reference.amplitude != "low":
            stated = max(stated, abs(found.peak_hz * s.stated_rate_hz / s.rate_hz - drive))
    arrays = {k: np.asarray(v, dtype=np.float64) for k, v in error.items()}
    return Shaker(arrays, float(np.mean(covered)), stated, clock)


def wrist_figures(signal: TremorSignal) -> tuple[Wrist, Inspection]:
    """``signal``: with reference windows of the rule's length, back to back from its start."""
    reference = signal.reference.windows
    assert reference is not None
    found = inspect(signal, replace(Rule(), window_s=reference.length_s))
    n = min(len(found.windows), len(reference.start_s))
    truth = reference.tremor[:n]
    share = np.array([w.share for w in found.windows[:n]])
    peak = np.array([w.peak_hz for w in found.windows[:n]])
    detected = np.array([w.tremor for w in found.windows[:n]])
    held = _held_out(share, truth)
    ranked = np.sort(share[truth])[::-1]
    low = float(np.quantile(share[~truth], 0.9))
    return (
        Wrist(
            float(np.mean(detected[truth])),
            float(np.mean(~detected[~truth])),
            float(np.mean(held[truth])),
            float(np.mean(~held[~truth])),
            n,
            int(truth.sum()),
            peak[truth] - reference.frequency_hz[:n][truth],
            (low, float(ranked[int(np.ceil(0.9 * len(ranked))) - 1])),
        ),
        found,
    )


def _held_out(share: Array, truth: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Return decisions by limits that were chosen on the other nine tenths (sensitivity plus specificity)."""
    detected = np.zeros(len(share), dtype=bool)
    for part in np.array_split(np.arange(len(share)), FOLDS):
        rest = np.setdiff1d(np.arange(len(share)), part)
        s, t = share[rest], truth[rest]
        limits = np.unique(s)
        gain = [np.mean(s[t] >= limit) + np.mean(s[~t] < limit) for limit in limits]
        best = np.flatnonzero(np.asarray(gain) >= max(gain) - 1e-12)
        # the middle of the gap below the best limit: any value in it does the same on these windows
        at = int(best[0])
        limit = 0.5 * (limits[at] + limits[at - 1]) if at > 0 else limits[at]
        detected[part] = share[part] >= limit
    return detected
