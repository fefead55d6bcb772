"""Computes the tremor that is left at the tip from the physical truth of a run.

The truth is logged by the emulated world apart from anything that the firmware sees.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from hal.arrays import Array
from tools.numbers import vector_rms

AXES = ("x", "y", "z")
TREMOR_BAND_HZ = (8.0, 12.0)
VOLUNTARY_HZ = 1.0
BANDS_HZ = ((0.0, 2.0), (2.0, 8.0), TREMOR_BAND_HZ, (20.0, 500.0), (2.0, 500.0))
"""Bands in which the error against the intended path is reported: what compensation adds elsewhere counts, too."""
FOUR_BANDS_HZ = BANDS_HZ[:4]
"""The bands that every report, table and picture of a run shows."""
SPECTRUM_HZ = (1, 1.25, 1.6, 2, 2.5, 3.15, 4, 5, 6.3, 8, 10, 12.5, 16, 20, 25, 31.5, 40, 50, 63, 80, 100, 125, 160, 200,
               250, 315, 400)  # fmt: skip
"""Centres of the third octaves of a spectrum (IEC 61260)."""
SHOWN_HZ = (1, 2, 4, 8, 10, 16, 31.5, 63, 125, 250, 400)
"""Those of them that a table of text shows."""
SEGMENT_S = 4.0


@dataclass(frozen=True)
class BandFigures:
    """Holds rms values in um, with the manipulator resting and working."""

    uncompensated_rms_um: float
    compensated_rms_um: float
    reduction_percent: float


def band_name(band_hz: tuple[float, float]) -> str:
    """Return "below 2 Hz" or "2-8 Hz"."""
    low_hz, high_hz = band_hz
    return f"below {high_hz:g} Hz" if low_hz <= 0.0 else f"{low_hz:g}-{high_hz:g} Hz"


def density_text(um_rtHz: float) -> str:
    """Return a density in five characters or less: 0.123, 12.3, 123."""
    return f"{um_rtHz:.{3 if um_rtHz < 1.0 else 1 if um_rtHz < 100.0 else 0}f}"


@dataclass(frozen=True)
class Spectrum:
    """Holds amplitude densities of the tip's error as a vector, um/sqrt(Hz), in the third octaves of ``hz``."""

    hz: tuple[float, ...] = ()
    without_um_rtHz: tuple[float, ...] = ()
    with_um_rtHz: tuple[float, ...] = ()


@dataclass(frozen=True)
class TremorFigures:
    """Holds the tip tremor in ``band_hz`` as a vector and per axis, and the error against the intended path in each of
    ``bands``, over all frequencies, and as a spectrum."""

    band_hz: tuple[float, float]
    evaluated_s: tuple[float, float]
    vector: BandFigures
    per_axis: dict[str, BandFigures]
    whole_band: BandFigures
    bands: dict[tuple[float, float], BandFigures]
    voluntary_gain: float
    voluntary_delay_ms: float
    spectrum: Spectrum = field(default_factory=Spectrum)

    def to_json(self) -> dict[str, Any]:
        """The ``tremor`` and ``voluntary`` parts of the run's JSON."""
        return {
            "tremor": {
                "band_hz": list(self.band_hz),
                "evaluated_s": list(self.evaluated_s),
                **asdict(self.vector),
                "per_axis": {axis: asdict(figures) for axis, figures in self.per_axis.items()},
                "whole_band_error": asdict(self.whole_band),
                "bands": [
                    {
                        "low_Hz": low,
                        "high_Hz": high,
                        "without_um": figures.uncompensated_rms_um,
                        "with_um": figures.compensated_rms_um,
                    }
                    for (low, high), figures in self.bands.items()
                ],
                "spectrum": {key: list(values) for key, values in asdict(self.spectrum).items()},
            },
            "voluntary": {"gain": self.voluntary_gain, "delay_ms": self.voluntary_delay_ms},
        }


def band_pass(x: Array, rate_hz: float, band_hz: tuple[float, float]) -> Array:
    """``x`` (n, k) in ``band_hz``, without phase shift (fourth-order Butterworth, forwards and backwards).

    A band that begins at 0 Hz is a low-pass, one that ends at or above half of ``rate_hz`` a high-pass.
    """
    from scipy.signal import butter, sosfiltfilt  # a second of CPU, which a run without figures does not need

    low_hz, high_hz = band_hz
    if low_hz <= 0.0:
        sos = butter(4, high_hz, btype="lowpass", fs=rate_hz, output="sos")
    elif high_hz >= 0.5 * rate_hz:
        sos = butter(4, low_hz, btype="highpass", fs=rate_hz, output="sos")
    else:
        sos = butter(4, band_hz, btype="bandpass", fs=rate_hz, output="sos")
    return np.asarray(sosfiltfilt(sos, x, axis=0))


def _compare(before: Array, after: Array) -> BandFigures:
    """Return the rms of vectors (n, k): the root of the summed axis variances."""
    rms_before, rms_after = (1e6 * vector_rms(e) for e in (before, after))
    reduction = 100.0 * (1.0 - rms_after / rms_before) if rms_before > 0 else float("nan")
    return BandFigures(rms_before, rms_after, reduction)


def tremor_figures(truth: Mapping[str, Array], *, from_ns: int, to_ns: int) -> TremorFigures | None:
    """Figures over the truth from ``from_ns`` to ``to_ns`` (bench time); ``None`` when that is less than 1 s.

    Filters run over the whole record, so that their own edges fall outside what is scored.
    """
    t_ns = np.asarray(truth["t_ns"])
    t_s = (t_ns - t_ns[0]) * 1e-9
    rate_hz = (len(t_s) - 1) / t_s[-1]
    keep = (t_ns >= from_ns) & (t_ns < to_ns)
    if np.count_nonzero(keep) < rate_hz:
        return None
    rigid, tip, intended = (np.asarray(truth[k]) for k in ("tip_rigid_m", "tip_m", "intended_m"))
    rigid_band, tip_band = (band_pass(x, rate_hz, TREMOR_BAND_HZ)[keep] for x in (rigid, tip))
    per_axis = {a: _compare(rigid_band[:, [i]], tip_band[:, [i]]) for i, a in enumerate(AXES)}
    # the manipulator's own rest offset is no error of the path: means are taken out
    errors = [x - intended for x in (rigid, tip)]
    centred = [e - e[keep].mean(axis=0) for e in errors]
    whole = _compare(*(e[keep] for e in centred))
    bands = {band: _compare(*(band_pass(e, rate_hz, band)[keep] for e in centred)) for band in BANDS_HZ}
    gain, delay_ms = _voluntary_response(rigid, tip, rate_hz, keep)
    return TremorFigures(
        TREMOR_BAND_HZ,
        (float(t_s[keep][0]), float(t_s[keep][-1])),
        _compare(rigid_band, tip_band),
        per_axis,
        whole,
        bands,
        gain,
        delay_ms,
        spectrum_of(*(e[keep] for e in centred), rate_hz=rate_hz),
    )


def spectrum_of(without_m: Array, with_m: Array, *, rate_hz: float) -> Spectrum:
    """Return the spectrum of two errors (n, k) in m: Welch's densities, summed over k, means over third octaves."""
    from scipy.signal import welch

    hz = [c for c in SPECTRUM_HZ if c < 0.5 * rate_hz]
    length = min(len(without_m), round(SEGMENT_S * rate_hz))
    densities: list[tuple[float, ...]] = []
    for error in (without_m, with_m):
        lines, density = welch(1e6 * error, rate_hz, nperseg=length, detrend="linear", axis=0)
        power = np.sum(density, axis=1)
        parts: list[float] = []
        for centre in hz:
            inside = (lines >= centre / 2 ** (1 / 6)) & (lines < centre * 2 ** (1 / 6))
            if not inside.any():  # a short run has no line in a narrow one
                inside[np.argmin(np.abs(lines - centre))] = True
            parts.append(float(np.sqrt(np.mean(power[inside]))))
        densities.append(tuple(parts))
    return Spectrum(tuple(map(float, hz)), *densities)


def _voluntary_response(rigid: Array, tip: Array, rate_hz: float, keep: NDArray[np.bool_]) -> tuple[float, float]:
    """Gain and delay from the resting to the working tip below 1 Hz, by regression on path and velocity."""
    slow_rigid, slow_tip = (band_pass(x, rate_hz, (0.0, VOLUNTARY_HZ)) for x in (rigid, tip))
    velocity = np.gradient(slow_rigid, 1.0 / rate_hz, axis=0)[keep]
    x, y = slow_rigid[keep], slow_tip[keep]
    x, y = x - x.mean(axis=0), y - y.mean(axis=0)
    design = np.column_stack([x.ravel(order="F"), velocity.ravel(order="F")])
    (gain, slope), *_ = np.linalg.lstsq(design, y.ravel(order="F"), rcond=None)
    return float(gain), float(-1e3 * slope / gain)
