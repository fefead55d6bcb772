"""The tip error of a bench over runs with different hands and noise, and whether one bench is better than another."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from scipy.stats import t as student

from hal.bench import BenchFile
from tools.closed_loop.simulate import simulate
from tools.errors import InputError
from tools.mismatch.recording import Array
from tools.reports.figures import tremor_figures

BANDS: tuple[str, ...] = ("below 2 Hz", "2-8 Hz", "8-12 Hz", "20-500 Hz")
WHOLE = "2-500 Hz"
SETTLE_S = 2.0
LEVEL = 0.05
"""Level of the paired tests over seeds."""
RISE_LEVEL = 0.2
"""Level at which a band counts as risen when a remedy is verified.

It is above ``LEVEL`` because an error of the first kind costs a remedy, and one of the second kind makes a bench worse.
"""
LEAST_FALL = 0.01
"""Smallest fall of the error, as a share of it, for which a bench is changed."""
PURPOSE = "8-12 Hz"
"""Band for which the instrument is made."""


@dataclass(frozen=True)
class TipError:
    """Holds the rms of the tip's error against the intended path, um, by band: one value per seed (seeds,)."""

    bands: Mapping[str, Array]

    def mean(self) -> dict[str, float]:
        """Return the mean over seeds, by band."""
        return {b: float(np.mean(v)) for b, v in self.bands.items()}


def tip_error(bench: BenchFile, seconds: float, seeds: Sequence[int]) -> TipError:
    """Run the bench in virtual time for each seed. Raises InputError if it has no such run or the run is too short."""
    out: dict[str, list[float]] = {b: [] for b in (*BANDS, WHOLE)}
    for seed in seeds:
        run = simulate(bench, seconds, seed=seed)
        found = tremor_figures(run.truth, from_ns=run.armed_ns + round(SETTLE_S * 1e9), to_ns=run.safe_ns)
        if found is None:
            raise InputError(f"--seconds {seconds:g}: too short to judge the tip after {SETTLE_S:g} s; give 5 or more")
        for name, figures in zip((*BANDS, WHOLE), found.bands.values(), strict=True):
            out[name].append(figures.compensated_rms_um)
    return TipError({b: np.array(v) for b, v in out.items()})


def is_worth_trying(before: TipError, after: TipError) -> tuple[bool, str]:
    """Decide by paired t-tests at ``LEVEL`` if ``after`` has less error on the same seeds; give the reason.

    The error in 8-12 Hz or that from 2 to 500 Hz must fall by ``LEAST_FALL`` or more.
    """
    change = _change(before, after)
    for band in (PURPOSE, WHOLE):
        fall = float(np.mean(-change[band]))
        is_enough = fall >= LEAST_FALL * float(np.mean(before.bands[band]))
        if is_enough and _p_above_zero(-change[band]) < LEVEL / 2:  # one of two bands is enough
            return True, f"the error {band} falls by {fall:.2g} um"
    return False, (
        f"neither the error {PURPOSE} nor that of {WHOLE} falls by {LEAST_FALL:.0%} or more, beyond what differs "
        "between runs"
    )


def is_better(before: TipError, after: TipError) -> tuple[bool, str]:
    """Decide if ``after`` is worth trying and no band rises (one-sided paired t-test at ``RISE_LEVEL``); say why."""
    rising = rises(before, after, RISE_LEVEL)
    if rising:
        return False, f"the error {', '.join(rising.values())}"
    return is_worth_trying(before, after)


def rises(before: TipError, after: TipError, level: float = LEVEL) -> dict[str, str]:
    """Return a statement for each band in which the error rises (one-sided paired t-test at ``level``), by band."""
    change = _change(before, after)
    return {b: f"{b} rises by {float(np.mean(d)):.2g} um" for b, d in change.items() if _p_above_zero(d) < level}


def _change(before: TipError, after: TipError) -> dict[str, Array]:
    return {b: after.bands[b] - before.bands[b] for b in (*BANDS, WHOLE)}


def _p_above_zero(x: Array) -> float:
    """Return the one-sided p-value of the null hypothesis that the mean of ``x`` is not above zero."""
    if float(np.ptp(x)) == 0.0:
        return 0.0 if x[0] > 0.0 else 1.0
    t = float(np.mean(x)) / (float(np.std(x, ddof=1)) / np.sqrt(x.size))
    return float(student.sf(t, x.size - 1))
