"""Counts the independent samples of a residual: many if it is noise, few if it is the error of a model's form."""

from __future__ import annotations

import math
from dataclasses import dataclass

from tools.mismatch.infer.constants import Constants


@dataclass(frozen=True)
class Count:
    """Holds the number of independent samples that a held-out residual counts for.

    ``noise``: as far as the residual is noise. ``form``: as far as it is an error of form. Such an error is smooth and
    repeats with the signals, so that it has few degrees of freedom, of which any effect removes some by chance.
    """

    noise: float
    form: float

    @staticmethod
    def of(c: Constants, held: int, recordings: int = 1) -> Count:
        """Return the count of ``held`` samples of ``recordings``: at most the samples that there are."""
        return Count(min(c.samples * recordings, float(held)), min(c.form_samples * recordings, float(held)))

    def lost(self, short: float) -> float:
        """Return the nats that a set loses whose mean log density is ``short`` nats per sample below that of noise.

        It is the integral of the count from 0 to ``short``. A residual whose variance is exp(2 l) times that of the
        noise is the sum of noise and form error; the degrees of freedom of the sum follow from those of its parts:
        1 / n = (1 / u)**2 / noise + (1 - 1 / u)**2 / form with u = exp(2 l) (Welch 1947; Satterthwaite 1946).
        """
        if short <= 0.0:
            return self.noise * short
        v, a = math.expm1(2.0 * min(short, 300.0)), math.sqrt(self.form / self.noise)
        return 0.5 * self.form * (math.log(math.hypot(v, a) / a) + math.atan2(v, a) / a)

    def curve_gain(self, short: float, share: float) -> float:
        """Return the nats that a set gains by removing ``share`` of its residual's variance, down to the noise."""
        better = short + 0.5 * math.log(max(1.0 - share, 1e-12))
        return max(self.lost(short) - self.lost(max(better, 0.0)), 0.0)
