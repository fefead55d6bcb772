"""Prepares arrays of a report for drawing: gaps, envelopes, held-out stretches, quantities of the axes."""

from __future__ import annotations

import itertools
from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from hal.arrays import Array
from tools.mismatch.engine.features import envelope, last_reversal, local_frequency, rate_of, recent_mean
from tools.mismatch.engine.report import DependsOn, Pictures, Report

Span = tuple[int, int]


CYCLES = 8  # of the strongest frequency, in a close-up


def step_s(p: Pictures) -> float:
    """Return the time between samples, s."""
    return float(np.min(np.diff(p.t)))


def runs(mask: NDArray[np.bool_], t: Array) -> list[Span]:
    """Return rows (start, stop) of the stretches where ``mask`` (m,) holds and time ``t`` (m,) has no gap."""
    if t.size == 0:
        return []
    gap = np.diff(t) > 1.5 * np.min(np.diff(t)) if t.size > 1 else np.zeros(0, bool)
    edges = [0, *(np.nonzero(gap | (np.diff(mask.astype(int)) != 0))[0] + 1).tolist(), t.size]
    return [(a, b) for a, b in itertools.pairwise(edges) if mask[a]]


def drawn_outputs(report: Report, most: int = 3) -> list[str]:
    """Return the outputs to draw: those with a mismatch, else the one with the largest residual over its noise."""
    f = report.fit
    order = sorted(f.unit, key=lambda o: -f.recalibrated_rms[o] / max(f.noise_floor_rms[o], 1e-300))
    guilty = [o for o in order if o in report.location.outputs]
    return (guilty or order[:1])[:most]


def envelope_line(t: Array, y: Array, columns: int = 900) -> tuple[Array, Array]:
    """Reduce a line to the least and greatest value of every pixel column, in order of time, (k,).

    The plot loses nothing that it could show. Gaps in time become NaN.
    """
    parts_t: list[Array] = []
    parts_y: list[Array] = []
    per = max(1, t.size // columns)
    for a, b in runs(np.ones(t.size, bool), t):
        if per <= 2:
            parts_t += [t[a:b], np.array([np.nan])]
            parts_y += [y[a:b], np.array([np.nan])]
            continue
        n = max(1, (b - a) // per)
        edges = np.linspace(a, b, n + 1).astype(int)
        at: list[int] = []
        for i, j in itertools.pairwise(edges.tolist()):
            at += sorted({i + int(np.argmin(y[i:j])), i + int(np.argmax(y[i:j]))})
        parts_t += [t[at], np.array([np.nan])]
        parts_y += [y[at], np.array([np.nan])]
    return np.concatenate(parts_t), np.concatenate(parts_y)


def zoom(p: Pictures, output: str) -> Span:
    """Return the rows of a held-out stretch of a few cycles where the recalibrated twin is worst."""
    residual = p.measured[output] - p.recalibrated[output]
    spans = runs(p.held_out, p.t) or [(0, p.t.size)]
    a, b = max(spans, key=lambda s: float(np.mean(residual[s[0] : s[1]] ** 2)))
    y = p.measured[output][a:b]
    power = np.abs(np.fft.rfft((y - y.mean()) * np.hanning(y.size))) ** 2
    cycle = (b - a) / max(int(np.argmax(power)), 1)
    length = int(min(b - a, max(CYCLES * cycle, 60)))
    total = np.concatenate([[0.0], np.cumsum(residual[a:b] ** 2)])
    start = a + int(np.argmax(total[length:] - total[:-length]))
    return start, start + length


def autocorrelation(residual: Array, spans: list[Span], most: int = 200) -> tuple[Array, float]:
    """Return the autocorrelation (lags + 1,) over stretches, and the 95 % band of a white residual."""
    longest = max(b - a for a, b in spans)
    lags = max(2, min(most, longest // 3))
    total, count = np.zeros(lags + 1), 0
    mean = np.mean(np.concatenate([residual[a:b] for a, b in spans]))
    for a, b in spans:
        e = residual[a:b] - mean
        if e.size <= lags:
            continue
        total += [float(e[: e.size - k] @ e[k:]) for k in range(lags + 1)]
        count += e.size
    return total / (total[0] or 1.0), 1.96 / np.sqrt(max(count, 1))


def spectrum(residual: Array, spans: list[Span], dt: float) -> tuple[Array, Array]:
    """Return (frequency Hz, amplitude density in unit/sqrt(Hz)) by Welch's method over stretches."""
    from scipy.signal import welch

    length = int(min(4096, max(np.median([b - a for a, b in spans]), 16)))
    used = [(a, b) for a, b in spans if b - a >= length] or [max(spans, key=lambda s: s[1] - s[0])]
    total: Array | None = None
    weight = 0
    frequency = np.zeros(1)
    for a, b in used:
        frequency, power = welch(residual[a:b], 1 / dt, nperseg=min(length, b - a), detrend="linear")
        if total is not None and total.shape != power.shape:
            continue
        total = power * (b - a) if total is None else total + power * (b - a)
        weight += b - a
    assert total is not None
    return frequency[1:], np.sqrt(total[1:] / weight)


def axis_of(p: Pictures, d: DependsOn) -> tuple[str, Array] | None:
    """Return label and values (m,) of the quantity that a residual follows; None if it was not recorded."""
    dt = step_s(p)
    seconds = max(20 * dt, p.t.size * dt / 60)
    if d.signal == "time":
        return "time (s)", p.t
    x = p.signals.get(d.signal, p.measured.get(d.signal))
    if x is None:
        return None
    makers: dict[str, tuple[str, Callable[[Array], Array]]] = {
        "rate": ("rate of {}", lambda v: rate_of(v, dt)),
        "sign of rate": ("rate of {}", lambda v: rate_of(v, dt)),
        "acceleration": ("acceleration of {}", lambda v: rate_of(rate_of(v, dt), dt)),
        "running extremum": ("last reversal of {}", lambda v: last_reversal(v, 0.05 * float(np.std(v)))),
        "recent history": ("{} less its recent mean", lambda v: v - recent_mean(v, seconds, dt)),
        "amplitude": ("amplitude of {}", lambda v: envelope(v, seconds, dt)),
        "frequency": ("frequency of {} (Hz)", lambda v: local_frequency(v, seconds, dt)),
    }
    label, make = makers.get(d.feature, ("{}", lambda v: v))
    unit = p.units.get(d.signal, "")
    over = {"rate": "/s", "sign of rate": "/s", "acceleration": "/s²"}.get(d.feature, "")
    suffix = "" if unit in ("", "1") or "(" in label else f" ({unit}{over})"
    return label.format(d.signal) + suffix, make(x)


def binned(x: Array, y: Array, bins: int = 24) -> tuple[Array, Array]:
    """Return the mean of ``y`` in bins of equal count along ``x``; a median would jump between a loop's branches."""
    order = np.argsort(x, kind="stable")
    parts = [i for i in np.array_split(order, min(bins, max(2, x.size // 20))) if i.size]
    return np.array([float(x[i].mean()) for i in parts]), np.array([float(y[i].mean()) for i in parts])


def limit(residuals: list[Array], held_out: NDArray[np.bool_]) -> float | None:
    """Return the half height of a residual's axis where other data (a start-up, a knock) would flatten the held-out
    data; else None.
    """
    if not held_out.any():
        return None
    height = 1.15 * max(float(np.max(np.abs(e[held_out]))) for e in residuals)
    return height if max(float(np.max(np.abs(e))) for e in residuals) > 2 * height > 0 else None
