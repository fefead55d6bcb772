"""Draws the pictures of a report: measured and simulated courses, and the residual before and after."""

from __future__ import annotations

from typing import Any

import numpy as np

from hal.arrays import Array
from tools.mismatch.engine.report import BetweenRecordings, Pictures, Report, Together
from tools.mismatch.report import series
from tools.mismatch.report.svg import AFTER, BEFORE, GIVEN, HELD, INK, MEASURED, NOISE, figure
from tools.mismatch.report.wording import scaled, shown_in

WIDTH_IN = 11.6
HALF_IN = 5.7
POINTS = 600
"""Number of dots of a cloud: enough to see its shape, few enough for a page of a megabyte."""


def _improved(report: Report) -> bool:
    return bool(report.physics)


def _shade_held_out(ax: Any, p: Pictures) -> None:
    dt = series.step_s(p)
    for i, (a, b) in enumerate(series.runs(p.held_out, p.t)):
        ax.axvspan(p.t[a], p.t[b - 1] + dt, color=HELD, alpha=0.16, lw=0, label="held out" if i == 0 else None)


def _residuals(report: Report, p: Pictures, output: str) -> list[tuple[str, str, Array]]:
    """Return (label, colour, residual) of the recalibrated twin, and of the twin with physics when there is any."""
    before = ("recalibrated", BEFORE, p.measured[output] - p.recalibrated[output])
    if not _improved(report):
        return [before]
    return [before, ("with physics", AFTER, p.measured[output] - p.fitted[output])]


def _legend(ax: Any) -> None:
    """Place the legend above the axes, beside the title, where it hides nothing."""
    ax.legend(loc="lower right", bbox_to_anchor=(1.0, 0.985), ncols=5, fontsize=9, borderaxespad=0.2)


def overlay(report: Report, p: Pictures, output: str, name: str) -> str:
    """Draw measured, as-given, recalibrated and fitted courses: the whole record and a close-up of held-out cycles."""
    measured = p.measured[output]
    factor, unit = scaled(float(np.ptp(measured)), report.fit.unit[output])
    a, b = series.zoom(p, output)
    with figure(name, (WIDTH_IN, 5.6)) as (fig, out):
        whole, close = fig.subplots(2, 1)
        _shade_held_out(whole, p)
        lines = [("as given", GIVEN, p.as_given[output], 1.0), ("recalibrated", BEFORE, p.recalibrated[output], 1.2)]
        if _improved(report):
            lines.append(("with physics", AFTER, p.fitted[output], 1.3))
        t, y = series.envelope_line(p.t, measured)
        whole.plot(t, y * factor, color=MEASURED, lw=2.2, alpha=0.5, label="measured")
        t, y = series.envelope_line(p.t, lines[-1][2])
        whole.plot(t, y * factor, color=lines[-1][1], lw=0.8, label=lines[-1][0])
        whole.set_title("the whole recording")
        close.plot(p.t[a:b], measured[a:b] * factor, color=MEASURED, lw=2.6, alpha=0.5, label="measured")
        for label, colour, y, wide in lines:
            style = "--" if label == "as given" else "-"
            close.plot(p.t[a:b], y[a:b] * factor, style, color=colour, lw=wide, label=label)
        close.set_title("close up: held-out data where the recalibrated twin is worst")
        for ax in (whole, close):
            ax.set_ylabel(f"{output} ({unit})")
            ax.margins(x=0)
            _legend(ax)
        close.set_xlabel("time (s)")
    return out[0]


def residual(report: Report, p: Pictures, output: str, name: str) -> str:
    """Draw the residual before and after over time; held-out data in full colour, fitted data faint."""
    noise = report.fit.noise_floor_rms[output]
    factor, unit = _residual_unit(report, output)
    with figure(name, (WIDTH_IN, 2.9)) as (fig, out):
        ax = fig.subplots()
        _shade_held_out(ax, p)
        for label, colour, e in _residuals(report, p, output):
            for mask, alpha, tag in ((~p.held_out, 0.25, None), (p.held_out, 1.0, label)):
                for i, (a, b) in enumerate(series.runs(mask, p.t)):
                    share = max(20, int(900 * (b - a) / p.t.size))
                    t, y = series.envelope_line(p.t[a:b], e[a:b], share)
                    ax.plot(t, y * factor, color=colour, lw=0.8, alpha=alpha, label=tag if i == 0 else None)
        ax.axhspan(
            -2 * noise * factor, 2 * noise * factor, color=NOISE, alpha=0.3, lw=0, label="± 2 noise floor", zorder=3
        )
        title = "residual: measured minus simulated"
        half = series.limit([e for _, _, e in _residuals(report, p, output)], p.held_out)
        if half is not None:
            ax.set_ylim(-max(half, 2 * noise) * factor, max(half, 2 * noise) * factor)
            title += " (the scale is that of held-out data)"
        ax.set_title(title)
        ax.set_ylabel(f"residual ({unit})")
        ax.set_xlabel("time (s)")
        ax.margins(x=0)
        _legend(ax)
    return out[0]


def follows(report: Report, p: Pictures, output: str, name: str) -> str:
    """Draw the held-out residual against the signal that it follows: clouds and running means, before and after."""
    axes: list[tuple[str, Array, str]] = []
    for d in report.location.depends_on:
        found = series.axis_of(p, d)
        if found is not None and found[0] not in (label for label, _, _ in axes):
            axes.append((*found, f": {100 * d.strength:.0f} %"))
    if not axes:
        axes = [(s, x, "") for s, x in p.signals.items() if np.ptp(x) > 0][:2]
    axes = axes[:2]
    if not axes:
        return ""
    rows = np.nonzero(p.held_out)[0] if p.held_out.any() else np.arange(p.t.size)
    pick = rows[np.linspace(0, rows.size - 1, min(POINTS, rows.size)).astype(int)]
    factor, unit = _residual_unit(report, output)
    with figure(name, (WIDTH_IN, 3.4)) as (fig, out):
        panels = fig.subplots(1, len(axes), squeeze=False)[0]
        for ax, (label, x, strength) in zip(panels, axes, strict=True):
            for tag, colour, e in _residuals(report, p, output):
                _dots(ax, x[pick], e[pick] * factor, colour)
                x_mid, e_mid = series.binned(x[rows], e[rows])
                ax.plot(x_mid, e_mid * factor, "-", color=colour, lw=2, label=f"{tag}, mean")
            ax.axhline(0, color=INK, lw=0.6)
            ax.set_xlabel(label)
            ax.set_title(f"against {label.split(' (')[0]}{strength}")
        panels[0].legend(loc="best", fontsize=9)
        panels[0].set_ylabel(f"residual ({unit})")
    return out[0]


def _residual_unit(report: Report, output: str) -> tuple[float, str]:
    return shown_in(report.fit, output, report.fit.recalibrated_rms[output])


def _dots(ax: Any, x: Array, y: Array, colour: str) -> None:
    """Draw a cloud as one path of points with round ends, which takes a tenth of the size of one element per dot."""
    width = 1e-4 * (float(np.ptp(x)) or 1.0)
    gap = np.full(x.size, np.nan)
    line = (np.column_stack([x, x + width, gap]).ravel(), np.column_stack([y, y, gap]).ravel())
    ax.plot(*line, color=colour, lw=2.6, alpha=0.35, solid_capstyle="round")


def spectra(report: Report, p: Pictures, output: str, name: str) -> str:
    """Draw the amplitude density of the held-out residual before and after, and of a white noise floor."""
    dt = series.step_s(p)
    factor, unit = _residual_unit(report, output)
    spans = series.runs(p.held_out, p.t) or series.runs(~p.held_out, p.t)
    with figure(name, (HALF_IN, 3.2)) as (fig, out):
        ax = fig.subplots()
        for label, colour, e in _residuals(report, p, output):
            f, density = _thin(*series.spectrum(e, spans, dt))
            ax.loglog(f, density * factor, color=colour, lw=1.1, label=label)
        white = report.fit.noise_floor_rms[output] * np.sqrt(2 * dt) * factor
        ax.axhline(white, color=NOISE, lw=2, label="noise floor, if white")
        ax.set_title("spectrum of the residual")
        ax.set_xlabel("frequency (Hz)")
        ax.set_ylabel(f"{unit}/√Hz")
        ax.legend(loc="best", fontsize=9)
    return out[0]


def _thin(f: Array, y: Array, most: int = 500) -> tuple[Array, Array]:
    """Reduce a spectrum to at most ``most`` points, geometrically spaced, each the root mean square of its band."""
    if f.size <= most:
        return f, y
    edges = np.unique(np.geomspace(1, f.size, most).astype(int)) - 1
    power = np.add.reduceat(y**2, edges) / np.diff(np.append(edges, f.size))
    return np.add.reduceat(f, edges) / np.diff(np.append(edges, f.size)), np.sqrt(power)


def autocorrelations(report: Report, p: Pictures, output: str, name: str) -> str:
    """Draw the autocorrelation of the held-out residual, with the band in which that of white noise stays."""
    spans = series.runs(p.held_out, p.t) or series.runs(~p.held_out, p.t)
    dt = series.step_s(p)
    with figure(name, (HALF_IN, 3.2)) as (fig, out):
        ax = fig.subplots()
        band = 0.0
        for label, colour, e in _residuals(report, p, output):
            r, band = series.autocorrelation(e, spans)
            ax.plot(np.arange(r.size) * dt, r, color=colour, lw=1.3, label=label)
        ax.axhspan(-band, band, color=NOISE, alpha=0.3, lw=0, label="white: 95 % band")
        ax.axhline(0, color=INK, lw=0.6)
        ax.set_title("autocorrelation of the residual")
        ax.set_xlabel("lag (s)")
        ax.margins(x=0)
        ax.set_ylim(None, 1.02)
        ax.legend(loc="upper right", fontsize=9)
    return out[0]


def between(together: Together, parameter: BetweenRecordings, name: str) -> str:
    """Draw a parameter of each recording, with 95 % intervals, over the condition that it follows, else in order."""
    change = next((c for c in together.changes if c.parameter == parameter.name), None)
    condition = change.condition if change is not None else "order"
    at = together.conditions[condition]
    words = [] if all(isinstance(v, float) for v in at) else list(dict.fromkeys(map(str, at)))
    x = np.array([float(words.index(str(v))) if words else float(v) for v in at])
    y = np.array(parameter.values)
    with figure(name, (HALF_IN, 3.2)) as (fig, out):
        ax = fig.subplots()
        ax.errorbar(x, y, 1.96 * np.array(parameter.standard_errors), fmt="o", color=AFTER, ms=4, lw=1.0, capsize=2)
        if change is not None and change.slope is not None:
            ends = np.array([x.min(), x.max()])
            ax.plot(ends, y.mean() + change.slope * (ends - x.mean()), color=BEFORE, lw=1.3)
        if words:
            ax.set_xticks(range(len(words)), words)
        ax.set_title(parameter.name + ("" if parameter.unit == "1" else f" ({parameter.unit})"))
        ax.set_xlabel(condition)
        ax.margins(x=0.08)
    return out[0]
