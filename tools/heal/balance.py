"""Weighs the tremor estimator anew beside a remedy that lowers the error in one band and raises it in another.

The adaptive estimator gives up some of the slow motion, and adds some noise above the band, to cancel more tremor. How
much is tuned for the model in the bench file. A wrong model (a delay that is not known, a loop that the inverse does
not have) makes the compensation fall behind, which acts as a smaller gain. With the right model the estimator does
all that its weights say, and the bands that paid less than intended pay in full. Each step here moves one weight
toward the band that rises.
"""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import dataclass, replace

from firmware_py.control.plan import load_plan
from hal.bench import BenchFile
from tools.calibrate.calibration_file import calibration_toml
from tools.heal.figures import BANDS

MOST_FADE_HZ = 2.0
"""Largest shift of the frequencies at which cancellation fades in. They are 3 to 6 Hz in a bench that ships."""
MOST_QUIET = 8.0
"""Largest factor on the penalty of noise above the band."""
MOST_DRIFT = 16.0
"""Largest factor on what is expected of gravity and bias below the band."""
LEAST_RELATIVE = 1.0 / 8.0
"""Smallest factor on the weight of the tremor band."""
SLOWEST, SLOW, _, FAST = BANDS


@dataclass(frozen=True)
class Balance:
    """Holds changes of the estimator's weights: ``fade_hz`` is added to ``cancel_from_hz``, the others multiply
    ``quiet``, ``drift_m_s2`` and ``relative``.
    """

    fade_hz: float = 0.0
    quiet: float = 1.0
    drift: float = 1.0
    relative: float = 1.0

    def calibration(self, bench: BenchFile) -> str:
        """Return a calibration file that changes the weights of ``bench`` by this balance."""
        plan = load_plan(bench)
        weights, table = plan.stages.tremor.adaptive, dict(plan.tables["tremor"].get("adaptive", {}))
        table |= {
            "cancel_from_hz": [f + self.fade_hz for f in weights.cancel_from_hz],
            "quiet": self.quiet * weights.quiet,
            "drift_m_s2": self.drift * weights.drift_m_s2,
            "relative": self.relative * weights.relative,
        }
        return calibration_toml(
            "weights of the tremor estimator", "micron mismatch heal", {"tremor": {"adaptive": table}}
        )

    def __str__(self) -> str:
        fade = [f"cancelling from {self.fade_hz:g} Hz higher"] if self.fade_hz else []
        factors = {name: getattr(self, name) for name in ("quiet", "drift", "relative")}
        return ", ".join([*fade, *(f"{name} x {factor:g}" for name, factor in factors.items() if factor != 1.0)])


def next_balance(balance: Balance, rising: Collection[str]) -> Balance | None:
    """Return the balance that gives way to the ``rising`` bands, None where there is none left."""
    changed = balance
    if SLOWEST in rising and balance.drift < MOST_DRIFT:
        changed = replace(changed, drift=2.0 * balance.drift)
    if SLOW in rising and balance.fade_hz < MOST_FADE_HZ:
        changed = replace(changed, fade_hz=balance.fade_hz + 1.0)
    if FAST in rising and balance.quiet < MOST_QUIET:
        changed = replace(changed, quiet=2.0 * balance.quiet)
    if changed != balance:
        return changed
    return replace(balance, relative=0.5 * balance.relative) if balance.relative > LEAST_RELATIVE else None


def is_weighed(bench: BenchFile) -> bool:
    """Return True if the bench's estimator has these weights, and they leave room for a change."""
    tremor = load_plan(bench).stages.tremor
    a = tremor.adaptive
    return tremor.method == "adaptive" and a.cancel_from_hz[1] + MOST_FADE_HZ < a.cancel_to_hz[0]
