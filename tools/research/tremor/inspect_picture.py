"""An inspection as a picture (spectrum over time, peaks, windows with tremor, mean spectrum) and as one page."""

from __future__ import annotations

import base64
import io
from html import escape
from typing import Any

import numpy as np

from tools.research.tremor.inspect import Inspection
from tools.research.tremor.spectrum import periodogram, segments

SHOWN_HZ = 20.0


def inspection_figure(found: Inspection) -> Any:
    """A matplotlib figure: above the spectrogram in dB with each window's peak, below the mean spectrum."""
    from matplotlib.figure import Figure

    signal, rule = found.signal, found.rule
    pieces = segments(signal.values, signal.rate_hz, rule.segment_s)
    spectra = [periodogram(p, signal.rate_hz) for p in pieces[:: max(1, len(pieces) // 1500)]]
    in_range = spectra[0].frequency_hz <= SHOWN_HZ
    level_dB = 10.0 * np.log10(np.maximum(np.array([s.density[in_range] for s in spectra]).T, 1e-300))
    top = float(np.percentile(level_dB, 99.8))
    figure = Figure(figsize=(9.0, 6.5), dpi=110, layout="constrained")
    upper, lower = figure.subplots(2, 1, height_ratios=(2, 1))
    span = (signal.start_s, signal.start_s + signal.seconds, 0.0, float(spectra[0].frequency_hz[in_range][-1]))
    image = upper.imshow(level_dB, origin="lower", aspect="auto", extent=span, cmap="magma", vmin=top - 60.0, vmax=top)
    figure.colorbar(image, ax=upper, label=f"dB re 1 ({signal.unit})$^2$/Hz", pad=0.01)
    middle = np.array([w.start_s + 0.5 * rule.window_s for w in found.windows])
    peaks = np.array([w.peak_hz for w in found.windows])
    tremor = np.array([w.tremor for w in found.windows])
    upper.plot(middle[tremor], peaks[tremor], "c.", ms=5, label="peak of a window with tremor")
    upper.plot(middle[~tremor], peaks[~tremor], ".", color="0.7", ms=2, label="peak of a window without")
    upper.set(
        xlabel="time (s)", ylabel="frequency (Hz)", title=f"{signal.name}: {found.sentence()}", ylim=(0, SHOWN_HZ)
    )
    upper.legend(fontsize="x-small", loc="upper right")
    inside = (found.spectrum.frequency_hz > 0.2) & (found.spectrum.frequency_hz <= SHOWN_HZ)
    lower.semilogy(found.spectrum.frequency_hz[inside], found.spectrum.density[inside], lw=0.9)
    lower.axvspan(*rule.band_hz, color="0.92", label="band searched")
    lower.axvspan(found.low_hz, found.high_hz, color="tab:cyan", alpha=0.4, label="peak, 95 %")
    lower.set(xlabel="frequency (Hz)", ylabel=f"({signal.unit})$^2$/Hz", xlim=(0, SHOWN_HZ))
    lower.legend(fontsize="x-small", loc="upper right")
    return figure


def png_bytes(figure: Any) -> bytes:
    """The figure as PNG."""
    buffer = io.BytesIO()
    figure.savefig(buffer, format="png")
    return buffer.getvalue()


def page(found: list[Inspection]) -> str:
    """Return a self-contained HTML page."""
    parts = [
        "<!doctype html><html lang=en><meta charset=utf-8><title>Tremor inspection</title>",
        "<style>body{font:15px sans-serif;max-width:70em;margin:2em auto;padding:0 1em}img{max-width:100%}"
        "td,th{padding:.15em .7em;text-align:right}td:first-child,th:first-child{text-align:left}</style>",
        "<h1>Tremor inspection</h1>",
    ]
    for one in found:
        s = one.signal
        picture = base64.b64encode(png_bytes(inspection_figure(one))).decode()
        parts.append(f"<h2>{escape(s.name)}</h2><p>{escape(one.sentence())}.</p>")
        parts += [f"<p>{escape(note)}</p>" for note in s.notes]
        parts.append(f'<img alt="spectrum over time" src="data:image/png;base64,{picture}">')
        parts.append("<details><summary>windows</summary><table><tr><th>from (s)<th>peak (Hz)<th>95 % (Hz)")
        parts.append(f"<th>amplitude ({escape(s.unit)})<th>share<th>tremor</tr>")
        parts += [
            f"<tr><td>{w.start_s:.1f}<td>{w.peak_hz:.2f}<td>{w.low_hz:.2f} to {w.high_hz:.2f}<td>{w.amplitude:.4g}"
            f"<td>{w.share:.2f}<td>{'yes' if w.tremor else 'no'}</tr>"
            for w in one.windows
        ]
        parts.append("</table></details>")
    return "\n".join(parts)
