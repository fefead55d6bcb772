"""Describes a recording: spectrum over time, peak frequency with interval, amplitude, harmonics, tremor or not.

The recording is cut into windows of 4 s. A window's spectrum is averaged over 2 s segments that overlap by half; its
peak is the highest local maximum in the tremor band, refined on the window's own periodogram. A window holds tremor
when the 1.5 Hz around that peak carry at least ``Rule.least_share`` of all motion from 0.5 to 15 Hz: tremor is what is
narrow and not drowned by the rest of the motion. The rule has no unit: it serves any sensor and any amplitude.
"""

from __future__ import annotations

from dataclasses import asdict, dataclass
from typing import Any

import numpy as np

from hal.arrays import Array
from tools.research.tremor.signal import TremorSignal
from tools.research.tremor.spectrum import Spectrum, highest_line, line_spread_hz, mean_spectrum, periodogram, segments

HARMONICS = (2, 3)


@dataclass(frozen=True)
class Rule:
    """``least_share`` 0.3: three times what 1.5 Hz hold of a spectrum that is even over 0.5 to 15 Hz."""

    window_s: float = 4.0
    segment_s: float = 2.0
    band_hz: tuple[float, float] = (3.5, 15.0)
    whole_hz: tuple[float, float] = (0.5, 15.0)
    half_width_hz: float = 0.75
    least_share: float = 0.3


@dataclass(frozen=True)
class Window:
    """Describes a window. ``amplitude``: of a sine with the peak's power (root sum over axes), in the signal's unit.

    ``share``: of the power in ``Rule.whole_hz`` that lies around the peak. ``harmonics``: amplitude at 2 and 3 times
    the peak over that at the peak, nan above the recording's band. nan throughout where the band holds no peak.
    """

    start_s: float
    peak_hz: float
    low_hz: float
    high_hz: float
    amplitude: float
    share: float
    harmonics: tuple[float, ...]
    tremor: bool


@dataclass(frozen=True)
class Inspection:
    """``peak_hz`` with its 95 % interval: over the windows with tremor, over all if there is none.

    ``excursion``: amplitude as displacement (m) or angle (rad) at the peak frequency, by ``excursion_unit``.
    """

    signal: TremorSignal
    rule: Rule
    windows: tuple[Window, ...]
    spectrum: Spectrum
    peak_hz: float
    low_hz: float
    high_hz: float
    amplitude: float
    excursion: float
    excursion_unit: str
    harmonics: tuple[float, ...]

    @property
    def tremor_share(self) -> float:
        """Part of the windows that hold tremor."""
        return float(np.mean([w.tremor for w in self.windows]))

    @property
    def steady(self) -> bool:
        """Return True if the windows agree on a peak: an interval of at most 2 Hz."""
        return bool(self.high_hz - self.low_hz <= 2.0)

    def sentence(self) -> str:
        """Describe the result for people."""
        held = f"{100.0 * self.tremor_share:.0f} % of {len(self.windows)} windows hold tremor"
        if not self.steady:
            return f"{held}; the windows do not agree on a peak"
        return f"{held}; peak {self.peak_hz:.2f} Hz (95 %: {self.low_hz:.2f} to {self.high_hz:.2f})"

    def as_dict(self) -> dict[str, Any]:
        """Return everything but the samples and the spectrum for JSON."""
        signal = self.signal
        return {
            "name": signal.name,
            "subject": signal.subject,
            "quantity": signal.quantity,
            "unit": signal.unit,
            "axes": signal.axes,
            "seconds": signal.seconds,
            "rate_hz": signal.rate_hz,
            "stated_rate_hz": signal.stated_rate_hz,
            "notes": signal.notes,
            "peak_hz": self.peak_hz,
            "peak_ci95_hz": [self.low_hz, self.high_hz],
            "steady": self.steady,
            "amplitude": self.amplitude,
            "excursion": self.excursion,
            "excursion_unit": self.excursion_unit,
            "harmonics": self.harmonics,
            "tremor_share": self.tremor_share,
            "windows": [asdict(w) for w in self.windows],
        }


def inspect(signal: TremorSignal, rule: Rule | None = None) -> Inspection:
    """Every window and the whole. The recording is at least one window long (the loader sees to it)."""
    rule = rule or Rule()
    length = round(rule.window_s * signal.rate_hz)
    starts = range(0, len(signal.values) - length + 1, length)
    pieces = [signal.values[a : a + length] for a in starts]
    found = [
        _window(p, a / signal.rate_hz + signal.start_s, signal.rate_hz, rule)
        for a, p in zip(starts, pieces, strict=True)
    ]
    chosen = [i for i, w in enumerate(found) if w.tremor] or [i for i, w in enumerate(found) if np.isfinite(w.peak_hz)]
    chosen = chosen or list(range(len(found)))
    spectra = [periodogram(pieces[i], signal.rate_hz) for i in chosen]
    mean = mean_spectrum(spectra)
    peak_hz, low_hz, high_hz = _with_interval(spectra, rule, found[chosen[0]])
    amplitude = _amplitude(mean, peak_hz, rule.half_width_hz)
    order, unit = {"acceleration": (2, "m"), "angular rate": (1, "rad")}.get(signal.quantity, (0, signal.unit))
    return Inspection(
        signal,
        rule,
        tuple(found),
        mean_spectrum([periodogram(p, signal.rate_hz) for p in pieces]),
        peak_hz,
        low_hz,
        high_hz,
        amplitude,
        amplitude / (2.0 * np.pi * peak_hz) ** order,
        unit,
        _harmonics(mean, peak_hz, rule.half_width_hz, signal.rate_hz),
    )


def _window(values: Array, start_s: float, rate_hz: float, rule: Rule) -> Window:
    rough = mean_spectrum([periodogram(s, rate_hz) for s in segments(values, rate_hz, rule.segment_s)])
    near_hz = highest_line(rough, rule.band_hz)
    nothing = float("nan")
    if not np.isfinite(near_hz):
        return Window(start_s, nothing, nothing, nothing, nothing, 0.0, (nothing,) * len(HARMONICS), False)
    around = (near_hz - rule.half_width_hz, near_hz + rule.half_width_hz)
    whole = rough.power(rule.whole_hz)
    share = rough.power(around) / whole if whole > 0.0 else 0.0
    fine = periodogram(values, rate_hz)
    peak_hz = highest_line(fine, around)
    peak_hz = peak_hz if np.isfinite(peak_hz) else near_hz
    reach = 1.96 * line_spread_hz(fine, peak_hz, rule.half_width_hz, values.shape[1], rate_hz)
    return Window(
        start_s,
        peak_hz,
        peak_hz - reach,
        peak_hz + reach,
        _amplitude(rough, near_hz, rule.half_width_hz),
        share,
        _harmonics(rough, near_hz, rule.half_width_hz, rate_hz),
        share >= rule.least_share,
    )


def _with_interval(spectra: list[Spectrum], rule: Rule, only: Window) -> tuple[float, float, float]:
    """Peak of the mean spectrum; interval by the jackknife over windows, of one window by its own noise."""
    peak_hz = highest_line(mean_spectrum(spectra), rule.band_hz)
    n = len(spectra)
    if n < 3:
        reach = 0.5 * (only.high_hz - only.low_hz)
        return peak_hz, max(0.0, peak_hz - reach), peak_hz + reach
    from scipy.stats import t as student

    total = np.sum([s.density for s in spectra], axis=0)

    def without(i: int) -> float:
        rest = Spectrum(spectra[0].frequency_hz, total - spectra[i].density, spectra[0].segment_s)
        return highest_line(rest, rule.band_hz)

    left_out = np.array([without(i) for i in range(n)])
    spread = float(np.sqrt((n - 1) / n * np.sum((left_out - left_out.mean()) ** 2)))
    reach = float(student.ppf(0.975, n - 1)) * spread
    return peak_hz, max(0.0, peak_hz - reach), peak_hz + reach


def _amplitude(spectrum: Spectrum, at_hz: float, half_width_hz: float) -> float:
    return float(np.sqrt(2.0 * spectrum.power((at_hz - half_width_hz, at_hz + half_width_hz))))


def _harmonics(spectrum: Spectrum, at_hz: float, half_width_hz: float, rate_hz: float) -> tuple[float, ...]:
    base = _amplitude(spectrum, at_hz, half_width_hz)
    return tuple(
        _amplitude(spectrum, n * at_hz, half_width_hz) / base
        if base > 0.0 and n * at_hz + half_width_hz < 0.45 * rate_hz
        else float("nan")
        for n in HARMONICS
    )
