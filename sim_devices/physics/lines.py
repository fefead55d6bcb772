"""Periodic disturbances: mains hum and vibration, with amplitude and phase that may wander."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.special import gammaincc

from sim_devices.physics.drift import hats, knots_over
from sim_devices.physics.effect import Array, Context, Effect, Human, Parameter, Parts, Settings, Signature
from sim_devices.physics.statistics import thin

MAINS_HZ = (50.0, 60.0)
MOST_KNOTS = 24
MOST_VALUES = 60_000_000  # columns times samples: half a gigabyte


def tones(t: Array, frequency: float, orders: Sequence[float] = (1.0,)) -> Array:
    """Return the sine and cosine of each harmonic, (n, 2 * orders)."""
    cols: list[Array] = []
    for h in orders:
        phase = 2 * np.pi * h * frequency * t
        cols += [np.sin(phase), np.cos(phase)]
    return np.stack(cols, axis=1)


def carrier(t: Array, e: Array, frequency: float, width: float) -> Array:
    """Return the complex amplitude (windows,) of a line in windows of ``width`` seconds."""
    dt = t[1] - t[0]
    m = max(1, round(width / dt))
    c = (t.size // m) * m
    z = e[:c] * np.exp(-2j * np.pi * frequency * t[:c])
    return 2 * z.reshape(-1, m).mean(axis=1)


def carrier_kept(keep: NDArray[np.bool_], dt: float, width: float) -> NDArray[np.bool_]:
    """Return the mask (windows,) of the windows of ``carrier`` that lie completely in ``keep``."""
    m = max(1, round(width / dt))
    c = (keep.size // m) * m
    return np.all(keep[:c].reshape(-1, m), axis=1)


def periodogram(e: Array, keep: np.ndarray, dt: float) -> tuple[Array, Array]:
    """Return finely spaced frequencies and the power of the kept residual at them (gaps count as zeros)."""
    clean = np.where(keep, e - e[keep].mean(), 0.0)
    n = 1 << int(np.ceil(np.log2(2 * e.size)))
    return np.asarray(np.fft.rfftfreq(n, dt), np.float64), np.asarray(np.abs(np.fft.rfft(clean, n)) ** 2, np.float64)


def local_floor(power: Array, around: int) -> Array:
    """Return the running median of a spectrum in blocks: the noise under a line."""
    m = max(1, power.size // max(around, 1))
    width = power.size // m
    blocks = power[: m * width].reshape(m, width)
    centre = (np.arange(m) + 0.5) * width
    return np.interp(np.arange(power.size), centre, np.median(blocks, axis=1) / np.log(2))


def _peak(x: Array, residual: Array, ctx: Context, lo: float, hi: float, driven: bool) -> tuple[float, float]:
    """Find (frequency, power over the local floor) of the strongest line between lo and hi."""
    f, p = periodogram(residual, ctx.keep, ctx.dt)
    z = p / np.maximum(local_floor(p, 400), 1e-300)
    allowed = (f >= lo) & (f <= hi) & (f > 4 / (ctx.dt * ctx.t.size))
    if not driven:
        for m in MAINS_HZ:
            allowed &= np.abs((f + m / 2) % m - m / 2) > 0.6
        allowed &= ~_excited(x, ctx, f)
    if not np.any(allowed):
        return 0.0, 0.0
    i = int(np.argmax(np.where(allowed, z, 0.0)))
    return float(f[i]), float(z[i])


def _excited(x: Array, ctx: Context, f: Array) -> NDArray[np.bool_]:
    """Return a mask of the frequencies where an input has a line: a residual line there is a wrong response."""
    bad = np.zeros(f.size, bool)
    for name, s in ctx.signals.items():
        if float(np.ptp(s)) == 0 or name.startswith(("temperature", "supply")):
            continue
        g, p = periodogram(s, np.ones(s.size, bool), ctx.dt)
        # a line: strong, and far above its own neighbourhood (a broad spectrum is no line)
        line = ((p > 1e-4 * p.max()) & (p > 50.0 * local_floor(p, 400))).astype(np.float64)
        for h in (1, 2, 3):  # twice and three times as much: distortion
            bad |= np.interp(f / h, g, line) > 0
    return bad


def mean_turn(z: NDArray[Any], whole: NDArray[np.bool_]) -> float:
    """Return the mean rotation, in turns per window, of the phasors ``z`` (m,) between adjacent ``whole`` windows."""
    pair = whole[1:] & whole[:-1]
    turned = complex(np.sum(z[1:][pair] * np.conj(z[:-1][pair])))
    return float(np.angle(turned)) / (2 * np.pi) if turned else 0.0


def _settle(residual: Array, ctx: Context, f0: float, harmonics: int) -> Settings:
    """Choose the settings of a line; its knots of amplitude and phase are as few as their wander allows."""
    span = ctx.dt * ctx.t.size
    width = max(10 / f0, span / 200)
    knots = 1
    if span > 8 * width:
        whole = carrier_kept(ctx.keep, ctx.dt, width)
        # a steady line seems to wander when the frequency is off: the mean rotation per window is removed first
        f0 += mean_turn(carrier(ctx.t, residual, f0, width), whole) / width
        z = carrier(ctx.t, residual, f0, width)
        power = float(np.mean(np.abs(z[whole]) ** 2)) if whole.sum() > 8 else 0.0
        pair = whole[1:] & whole[:-1]
        if power > 0 and pair.any():
            # noise of one window from first differences; what varies beyond it is wander. Recordings that are shorter
            # than two windows have no pair, and no wander that noise could be told from.
            rough = float(np.mean(np.abs(np.diff(z)[pair]) ** 2)) / 2
            wander = float(np.var(z[whole]))
            if wander > max(1.5 * rough, 0.01 * power):
                knots = int(np.clip(np.ceil(span / (4 * width)), 4, MOST_KNOTS))
    orders = _orders(residual, ctx, f0, harmonics)
    knots = max(1, min(knots, MOST_VALUES // (2 * len(orders) * ctx.t.size)))
    grid = knots_over(ctx.t, ctx.keep, knots) if knots > 1 else (0.0,)
    return {"nominal": (f0,), "orders": orders, "span": (span,), "knots_s": grid}


def _orders(residual: Array, ctx: Context, f0: float, harmonics: int) -> tuple[float, ...]:
    """Return the orders of the fundamental and of the harmonics that stand out of the spectrum."""
    f, p = periodogram(residual, ctx.keep, ctx.dt)
    z = p / np.maximum(local_floor(p, 400), 1e-300)
    out = [1.0]
    reach = 2.0 / (ctx.dt * ctx.t.size)
    for h in range(2, harmonics + 1):
        near = np.abs(f - h * f0) <= h * reach
        if near.any() and float(z[near].max()) > 30.0:
            out.append(float(h))
    return tuple(out)


def _mains_prepare(x: Array, residual: Array, ctx: Context) -> Settings:
    nyquist = 0.5 / ctx.dt
    f0, best = 50.0, -1.0
    for m in MAINS_HZ:
        f, z = _peak(x, residual, ctx, 0.99 * m, min(1.01 * m, 0.99 * nyquist), True) if m < nyquist else (m, -1.0)
        if z > best and f > 0:
            f0, best = f, z
    harmonics = int(max(1, min(5, 0.9 * nyquist // f0)))
    return _settle(residual, ctx, f0, harmonics)


def _line_parts(settings: Settings) -> Parts:
    f0 = settings.get("nominal", (50.0,))[0]
    orders = settings.get("orders", (1.0,))
    h = len(orders)
    span = settings.get("span", (1.0,))[0]
    knots = len(settings.get("knots_s", (0.0,)))
    reach = max(2.0 / span, 2e-4 * f0)
    names = [f"{p}{int(i)}" for i in orders for p in ("sin", "cos")]
    if knots > 1:
        names = [f"{m}_{k + 1}" for m in names for k in range(knots)]
    penalty = 0.02 * np.eye(len(names))
    if knots > 2:
        bend = np.diff(np.eye(knots), axis=0)
        penalty = np.concatenate([penalty, np.asarray(0.2 * np.kron(np.eye(2 * h), bend), np.float64)])
    return Parts(
        (Parameter("frequency_Hz", "Hz", f0 - reach, f0 + reach, scale=0.1 / span),),
        tuple(Parameter(m, "{out}") for m in names),
        penalty,
    )


def _line_basis(x: Array, ctx: Context, q: Array, settings: Settings) -> Array:
    c = tones(ctx.t, q[0], settings.get("orders", (1.0,)))
    knots = np.array(settings.get("knots_s", (0.0,)))
    if knots.size == 1:
        return c
    h = hats(ctx.t, knots)
    return np.concatenate([c[:, j : j + 1] * h for j in range(c.shape[1])], axis=1)


def _line_report(p: Array, settings: Settings, scale: float) -> Sequence[Human]:
    knots = len(settings.get("knots_s", (0.0,)))
    orders = settings["orders"]
    h = len(orders)
    w = p[1:].reshape(2 * h, knots)
    amplitudes = np.sqrt(np.mean(w[0::2] ** 2 + w[1::2] ** 2, axis=1))
    at = np.array(settings["knots_s"])
    turns = spread = 0.0
    if knots > 1:
        # sin w1 + cos w2 with slow w: the phase that the amplitudes carry is frequency, too
        z = w[1] - 1j * w[0]
        weight = np.minimum(np.abs(z[1:]), np.abs(z[:-1]))
        step = np.angle(z[1:] * np.conj(z[:-1])) / (2 * np.pi * np.diff(at))
        turns = float(np.sum(weight * step) / max(float(np.sum(weight)), 1e-300))
        spread = mean_spread(step - turns, weight)
    return (
        Human("frequency_Hz", float(p[0]) + turns, "Hz", spread),
        *(Human(f"amplitude_{int(i)}", float(a), "{out}") for i, a in zip(orders, amplitudes, strict=True)),
    )


def mean_spread(deviation: Array, weight: Array) -> float:
    """Return the standard deviation of a weighted mean from the deviations (m,) of correlated values.

    The effective number of values is m (1 - r) / (1 + r), with r the correlation of neighbours (Bartlett, J. Royal
    Statistical Society 98, 1935).
    """
    power = float(np.sum(weight * deviation**2) / max(float(np.sum(weight)), 1e-300))
    if deviation.size < 3 or power == 0.0:
        return float(np.sqrt(power))
    r = float(np.clip(np.mean(deviation[1:] * deviation[:-1]) / np.mean(deviation**2), 0.0, 0.9))
    return float(np.sqrt(power * (1 + r) / (1 - r) / deviation.size))


def _line_signature(z: float, f: float, trials: float, residual: Array, ctx: Context) -> Signature:
    """Return the test of a spectral line: a bin of a white spectrum is exponential, so p = trials exp(-z)."""
    k = thin(ctx.keep, 40_000)
    if f <= 0:
        return Signature(1.0, 0.0, "no line")
    cols = tones(ctx.t[k], f)
    e = residual[k] - residual[k].mean()
    w = np.linalg.lstsq(cols, e, rcond=None)[0]
    power = float(e @ e)
    share = 1 - float(np.sum((e - cols @ w) ** 2)) / power if power > 0 else 0.0
    # the floor is estimated and coloured, so only a quarter of the excess counts
    return Signature(float(min(1.0, trials * gammaincc(1.0, 0.5 * z))), max(share, 0.0), f"line at {f:.4g} Hz")


def _mains_test(x: Array, residual: Array, ctx: Context) -> Signature:
    best = (0.0, 0.0)
    for m in MAINS_HZ:
        if m < 0.5 / ctx.dt:
            found = _peak(x, residual, ctx, 0.99 * m, 1.01 * m, True)
            best = max(best, found, key=lambda b: b[1])
    return _line_signature(best[1], best[0], 4 * 50 * ctx.dt * ctx.t.size * 0.02 + 2, residual, ctx)


def _vibration_prepare(x: Array, residual: Array, ctx: Context) -> Settings:
    f0, _ = _peak(x, residual, ctx, 0.0, 0.49 / ctx.dt, False)
    f0 = f0 or 0.1 / ctx.dt
    return _settle(residual, ctx, f0, 1 if 2 * f0 > 0.45 / ctx.dt else 2)


def _vibration_test(x: Array, residual: Array, ctx: Context) -> Signature:
    f, z = _peak(x, residual, ctx, 0.0, 0.49 / ctx.dt, False)
    return _line_signature(z, f, ctx.t.size, residual, ctx)


MAINS_INTERFERENCE = Effect(
    name="mains_interference",
    summary="50 or 60 Hz and harmonics",
    kind="add",
    stages=("acquisition", "environment"),
    parts=_line_parts,
    equation=r"y = x + \sum_h A_h(t) \sin 2\pi h f t + B_h(t) \cos 2\pi h f t,\; A, B \text{ slow}",
    source="H. W. Ott, Electromagnetic Compatibility Engineering, chapters 2-3; IEC 61000-4-7 for harmonics",
    excitation="a sampling rate above 100 Hz",
    confusable_with=("vibration",),
    prepare=_mains_prepare,
    guess=lambda x, residual, ctx, settings: ((settings["nominal"][0],),),
    basis=_line_basis,
    test=_mains_test,
    report=_line_report,
    driven=False,
    sites=("output",),
    vanishes_with=(("amplitude_*",),),
)

VIBRATION = replace(
    MAINS_INTERFERENCE,
    name="vibration",
    summary="a narrow line elsewhere in the spectrum, not driven by the input",
    stages=("environment", "mounting", "mechanics"),
    source="M. B. Priestley, Spectral Analysis and Time Series, section 6.1.4 (Fisher's test for a line)",
    excitation="an input without lines near that frequency",
    confusable_with=("mains_interference", "resonance"),
    prepare=_vibration_prepare,
    test=_vibration_test,
    # a mains line that wanders has skirts beside the band where its own search looks
    forbidden={"frequency_Hz": tuple((0.99 * m, 1.01 * m) for m in MAINS_HZ)},
)
