"""Power spectra of several axes together, and where their highest line is."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from hal.arrays import Array

PADDING = 8  # frequency grid this much finer than 1 / length: the parabola is then good to 1e-3 of a bin


@dataclass(frozen=True)
class Spectrum:
    """One-sided density, summed over the axes. ``density`` (m,) in unit^2/Hz on ``frequency_hz`` (m,), from 0 Hz.

    ``segment_s``: length of what was transformed at once; the resolution is about 2 / ``segment_s`` (Hann window).
    """

    frequency_hz: Array
    density: Array
    segment_s: float

    @property
    def step_hz(self) -> float:
        return float(self.frequency_hz[1])

    def inside(self, band_hz: tuple[float, float]) -> NDArray[np.bool_]:
        """Return the mask of the grid in ``band_hz``, ends included."""
        return (self.frequency_hz >= band_hz[0]) & (self.frequency_hz <= band_hz[1])

    def power(self, band_hz: tuple[float, float]) -> float:
        """unit^2 in ``band_hz``."""
        return float(np.sum(self.density[self.inside(band_hz)])) * self.step_hz


def periodogram(values: Array, rate_hz: float) -> Spectrum:
    """Hann-windowed periodogram of ``values`` (n, k), straight lines removed, axes summed."""
    n = len(values)
    ramp = np.linspace(-1.0, 1.0, n)
    slope = ramp @ values / (ramp @ ramp)
    level = values.mean(axis=0)
    window = 0.5 - 0.5 * np.cos(2.0 * np.pi * (np.arange(n) + 0.5) / n)
    size = 1 << int(np.ceil(np.log2(PADDING * n)))
    lines = np.fft.rfft((values - level - ramp[:, None] * slope) * window[:, None], size, axis=0)
    density = np.sum(np.abs(lines) ** 2, axis=1) * (2.0 / (rate_hz * np.sum(window**2)))
    return Spectrum(np.asarray(np.fft.rfftfreq(size, 1.0 / rate_hz), dtype=np.float64), density, n / rate_hz)


def highest_line(spectrum: Spectrum, band_hz: tuple[float, float]) -> float:
    """Frequency (Hz) of the highest local maximum in ``band_hz``, between grid points by a parabola through the logs.

    nan where the band holds no local maximum, so that a slope that ends at the band's edge is no peak.
    """
    d = spectrum.density
    inside = np.flatnonzero(spectrum.inside(band_hz))
    inside = inside[(inside > 0) & (inside < len(d) - 1)]
    tops = inside[(d[inside] >= d[inside - 1]) & (d[inside] > d[inside + 1])]
    if tops.size == 0:
        return float("nan")
    at = int(tops[np.argmax(d[tops])])
    left, top, right = np.log(np.maximum(d[at - 1 : at + 2], 1e-300))
    bend = left - 2.0 * top + right
    shift = 0.5 * (left - right) / bend if bend < 0.0 else 0.0
    return float((at + shift) * spectrum.step_hz)


def segments(values: Array, rate_hz: float, segment_s: float) -> list[Array]:
    """Pieces of ``values`` (n, k) of ``segment_s``, overlapping by half; all of it if it is shorter."""
    length = min(len(values), round(segment_s * rate_hz))
    return [values[a : a + length] for a in range(0, len(values) - length + 1, max(1, length // 2))]


def mean_spectrum(spectra: list[Spectrum]) -> Spectrum:
    """Mean density of spectra on one grid."""
    density = np.asarray(np.mean([s.density for s in spectra], axis=0), dtype=np.float64)
    return Spectrum(spectra[0].frequency_hz, density, spectra[0].segment_s)


def line_spread_hz(spectrum: Spectrum, at_hz: float, half_width_hz: float, axes: int, rate_hz: float) -> float:
    """Standard deviation of the frequency of a line at ``at_hz`` of a Hann periodogram, Hz.

    A tone of power P per sum of axes in noise of density N per axis: var(w) = (N rate / (2 P)) sum(h^2 t^2) /
    sum(h t^2)^2 with the window h (first order, Rife and Boorstyn 1974; without window it is their bound). N is the
    mean density from 1 to 3 half widths off the line, so that a tremor's own unsteadiness counts as noise.
    """
    off = np.abs(spectrum.frequency_hz - at_hz)
    beside = (off > half_width_hz) & (off <= 3.0 * half_width_hz) & (spectrum.frequency_hz > 0.0)
    noise = float(np.mean(spectrum.density[beside])) / axes
    power = spectrum.power((at_hz - half_width_hz, at_hz + half_width_hz))
    n = round(spectrum.segment_s * rate_hz)
    t = (np.arange(n) - 0.5 * (n - 1)) / rate_hz
    h = 0.5 - 0.5 * np.cos(2.0 * np.pi * (np.arange(n) + 0.5) / n)
    shape = float(np.sum(h**2 * t**2) / np.sum(h * t**2) ** 2)
    return float(np.sqrt(0.5 * noise * rate_hz / max(power, 1e-300) * shape) / (2.0 * np.pi))
