"""Effects that transform one signal: memory, curvature, limits and linear dynamics.

A maker draws all random choices of a form and returns ``transform(x, dt, s)`` on a signal that is
normalised to [-1, 1], with the strength range of ``s``. ``ports.py`` wires it to a drive or an output.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from scipy.signal import bilinear, fftconvolve, lfilter, lfilter_zi

from hal.arrays import Array
from tools.research.prove import kernels

Rng = np.random.Generator
Transform = Callable[[Array, float, float], Array]


@dataclass(frozen=True)
class Shape:
    """One form of an effect on a normalised signal."""

    form: str
    transform: Transform
    strength: tuple[float, float] = (1e-5, 2.0)
    truth: Callable[[float], dict[str, tuple[float, str]]] | None = None


def _added(form: str, memory: Callable[[Array, float], Array]) -> Shape:
    """x + s h(x), h normalised; h does not depend on s and is kept for one signal."""
    kept: dict[tuple[int, float, float], Array] = {}

    def transform(x: Array, dt: float, s: float) -> Array:
        key = (x.size, float(x[x.size // 3]), float(np.sum(x)))
        if key not in kept:
            kept.clear()
            h = memory(x, dt)
            kept[key] = h / max(float(np.max(np.abs(h))), 1e-12)
        return x + s * kept[key]

    return Shape(form, transform)


def hysteresis(rng: Rng) -> Shape:
    form = str(rng.choice(["bouc_wen", "bouc_wen_asymmetric", "preisach", "maxwell_slip", "jiles", "hodgdon"]))
    if form.startswith("bouc_wen"):
        total = rng.uniform(1.5, 6.0)
        beta = total * rng.uniform(0.4, 0.8)
        up = total - beta
        down = up * (rng.uniform(0.1, 0.6) if form.endswith("asymmetric") else 1.0)
        power = float(rng.choice([1.0, 1.0, 1.5, 2.0]))
        return _added(form, lambda x, dt: kernels.bouc_wen(x, 1.0, beta, up, down, power))
    if form == "preisach":
        n = int(rng.integers(14, 22))
        grid = np.linspace(-1.05, 1.05, n)
        up, down = (g.ravel() for g in np.meshgrid(grid, grid))
        keep = up >= down
        up, down = up[keep], down[keep]
        centre, spread = rng.normal(0, 0.2), rng.uniform(0.35, 0.8)
        weight = np.exp(-0.5 * (((up + down) / 2 - centre) / spread) ** 2 - (up - down) / rng.uniform(0.3, 0.9))
        # a fine grid of relays still makes steps; blur the thresholds
        up, down = up + rng.uniform(-0.07, 0.07, up.size), down - rng.uniform(0, 0.07, up.size)
        return _added(form, lambda x, dt: kernels.relays(x, up, down, weight))
    if form == "maxwell_slip":
        count = int(rng.integers(4, 12))
        reach = np.sort(rng.uniform(0.03, 0.9, count))
        stiff = rng.uniform(0.2, 1.0, count) / (0.3 + reach)
        return _added(form, lambda x, dt: kernels.slip_elements(x, stiff, reach))
    if form == "jiles":
        a, k, c = rng.uniform(0.25, 0.5), rng.uniform(0.2, 0.5), rng.uniform(0.05, 0.3)
        coupling = rng.uniform(0.0, 0.1)
        return _added(form, lambda x, dt: kernels.jiles(x, a, k, c, coupling))
    sp, sl = rng.uniform(1.5, 5.0), rng.uniform(0.6, 1.2)
    inner = sl * rng.uniform(0.1, 0.6)
    return _added(form, lambda x, dt: kernels.hodgdon(x, sp, sl, inner))


def rate_dependent_hysteresis(rng: Rng) -> Shape:
    form = str(rng.choice(["rate_factor", "leaking", "viscoelastic_series"]))
    total = rng.uniform(2.0, 6.0)
    beta = total * rng.uniform(0.5, 0.8)
    share = rng.uniform(0.3, 0.9)
    ratio = 10 ** rng.uniform(-1.0, -0.3)

    def memory(x: Array, dt: float) -> Array:
        speed = float(np.sqrt(np.mean(np.gradient(x, dt) ** 2)))
        if form == "rate_factor":
            return kernels.bouc_wen_rate(x, dt, 1.0, beta, total - beta, 0.35 + 0.5 * share, ratio * speed, 0.0)
        if form == "leaking":
            return kernels.bouc_wen_rate(x, dt, 1.0, beta, total - beta, 0.0, 1.0, (0.5 + 2 * share) * speed)
        z = kernels.bouc_wen(x, 1.0, beta, total - beta, total - beta, 1.0)
        tau = (0.15 + 0.5 * share) / speed
        return z + 0.8 * high_pass(z, dt, tau) + 0.4 * high_pass(x, dt, 0.5 * tau)

    return _added(form, memory)


def lti(num: list[float], den: list[float], x: Array, dt: float) -> Array:
    """Continuous transfer function applied on the fine grid, at rest in its steady state for x[0]."""
    b, a = (np.atleast_1d(np.asarray(v, float)) for v in bilinear(num, den, fs=1.0 / dt))
    zi = lfilter_zi(b, a) if abs(np.sum(a)) > 1e-14 else np.zeros(max(len(a), len(b)) - 1)
    y, _ = lfilter(b, a, x, zi=zi * x[0])
    return y


def high_pass(x: Array, dt: float, tau: float) -> Array:
    return lti([tau, 0.0], [tau, 1.0], x, dt)


def creep(rng: Rng) -> Shape:
    form = str(rng.choice(["log_time", "power_law", "voigt_chain"]))
    t0 = 10 ** rng.uniform(-1.3, -0.3)
    power = rng.uniform(0.08, 0.3)
    count = int(rng.integers(4, 7))
    weight = rng.uniform(0.6, 1.4, count)
    fresh = rng.random() < 0.5

    def memory(x: Array, dt: float) -> Array:
        t = dt * np.arange(x.size)
        first = max(t0, 2 * dt)
        if form == "log_time":
            kernel = np.log10(1.0 + t / first)
        elif form == "power_law":
            kernel = (1.0 + t / first) ** power - 1.0
        else:
            taus = np.geomspace(2 * first, max(0.6 * t[-1], 10 * first), count)
            kernel = np.sum(weight[:, None] * (1.0 - np.exp(-t[None, :] / taus[:, None])), axis=0)
        # before the record: unloaded, like a stage switched on, or long settled at its first level
        steps = np.diff(x, prepend=0.0 if fresh else x[0])
        return fftconvolve(steps, kernel)[: x.size]

    return _added(form, memory)


def backlash(rng: Rng) -> Shape:
    form = str(rng.choice(["plain", "compliant", "rounded"]))
    share = rng.uniform(0.03, 0.12)

    def transform(x: Array, dt: float, s: float) -> Array:
        if form == "plain":
            return kernels.free_play(x, s, 0.0)
        if form == "compliant":
            return kernels.free_play(x, s, share)
        # contact stiffens gradually: a bundle of plays with spread gaps
        return np.mean([kernels.free_play(x, s * g, 0.0) for g in (0.85, 0.95, 1.05, 1.15)], axis=0)

    return Shape(form, transform, (1e-5, 0.6), lambda s: {"gap": (2 * s, "norm"), "half_gap": (s, "norm")})


def dead_zone(rng: Rng) -> Shape:
    form = str(rng.choice(["plain", "asymmetric", "rounded"]))
    other = rng.uniform(0.3, 1.0) if form == "asymmetric" else 1.0

    def transform(x: Array, dt: float, s: float) -> Array:
        if form == "rounded":
            return x - s * np.tanh(x / s)
        return x - np.clip(x, -other * s, s)

    return Shape(form, transform, (1e-4, 0.6))


def saturation(rng: Rng) -> Shape:
    """Limits that are reached: the output flattens. (A gentle tanh alone would only be curvature.)"""
    form = str(rng.choice(["hard", "one_sided", "asymmetric", "soft_power", "soft_knee"]))
    side = float(rng.choice([-1.0, 1.0]))
    other = rng.uniform(0.0, 0.6)
    power = rng.uniform(6.0, 14.0)
    knee = rng.uniform(0.75, 0.95)

    def transform(x: Array, dt: float, s: float) -> Array:
        limit = 1.0 - s
        if form == "hard":
            return np.clip(x, -limit, limit)
        if form == "one_sided":
            return side * np.minimum(side * x, limit)
        if form == "asymmetric":
            return side * np.clip(side * x, other * s - 1.0, limit)
        if form == "soft_power":
            return x / (1.0 + np.abs(x / limit) ** power) ** (1.0 / power)
        start, room = knee * limit, (1.0 - knee) * limit
        over = np.maximum(np.abs(x) - start, 0.0)
        return np.sign(x) * (np.minimum(np.abs(x), start) + room * np.tanh(over / room))

    return Shape(form, transform, (-0.4 if form == "soft_power" else 1e-4, 0.85))


def static_nonlinearity(rng: Rng) -> Shape:
    form = str(rng.choice(["quadratic", "cubic", "exponential", "mixed", "bow"]))
    sign = float(rng.choice([-1.0, 1.0]))
    c = rng.uniform(0.3, 0.8)

    def curve(x: Array) -> Array:
        if form == "quadratic":
            return sign * x**2
        if form == "cubic":
            return x**3
        if form == "exponential":
            return sign * (np.exp(c * 2 * x) - 1.0)
        if form == "mixed":
            return sign * (x**2 + sign * c * x**3)
        return sign * np.cos(0.5 * np.pi * x)

    return Shape(form, lambda x, dt, s: x + s * curve(x), (1e-5, 0.45))


def slew_limit(rng: Rng) -> Shape:
    form = str(rng.choice(["hard", "rounded"]))
    soft = rng.uniform(0.002, 0.01)

    def transform(x: Array, dt: float, s: float) -> Array:
        top = float(np.quantile(np.abs(np.diff(x)), 0.9995))
        return kernels.limited_rate(x, top / s, soft if form == "rounded" else 0.0)

    return Shape(form, transform, (1.02, 60.0))


def first_order_lag(rng: Rng) -> Shape:
    form = str(rng.choice(["rc", "rc_loaded"]))
    extra = rng.uniform(0.02, 0.08) if form == "rc_loaded" else 0.0

    def transform(x: Array, dt: float, s: float) -> Array:
        return lti([1.0], [extra * s * s, s * (1.0 + extra), 1.0] if extra else [s, 1.0], x, dt)

    truth = None if extra else (lambda s: {"time_constant": (s, "s"), "corner": (1 / (2 * np.pi * s), "Hz")})
    return Shape(form, transform, (1e-6, 0.12), truth)


def ac_coupling(rng: Rng) -> Shape:
    form = str(rng.choice(["first_order", "second_order"]))

    def transform(x: Array, dt: float, s: float) -> Array:
        tau = 1.0 / (2 * np.pi * s)
        if form == "first_order":
            return lti([tau, 0.0], [tau, 1.0], x, dt)
        w = 2 * np.pi * s
        return lti([1.0, 0.0, 0.0], [1.0, 1.4 * w, w * w], x, dt)

    return Shape(form, transform, (1e-5, 2.0), lambda s: {"corner": (s, "Hz")} if form == "first_order" else {})


def resonance(rng: Rng) -> Shape:
    form = str(rng.choice(["series", "residual_mode"]))
    zeta = 10 ** rng.uniform(-2.0, -0.9)
    place = rng.uniform(0.0, 1.0)

    def transform(x: Array, dt: float, s: float) -> Array:
        if form == "series":
            w = 2 * np.pi * 2000.0 / s
            return lti([w * w], [1.0, 2 * zeta * w, w * w], x, dt)
        w = 2 * np.pi * 12.0 * (60.0 / 12.0) ** place
        return x + s * lti([1.0, 0.0, 0.0], [1.0, 2 * zeta * w, w * w], x, dt)

    def truth(s: float) -> dict[str, tuple[float, str]]:
        f = 2000.0 / s if form == "series" else 12.0 * (60.0 / 12.0) ** place
        return {"frequency": (f, "Hz"), "damping_ratio": (zeta, "1")}

    return Shape(form, transform, (10.0, 400.0) if form == "series" else (1e-5, 5.0), truth)


def dead_time(rng: Rng) -> Shape:
    def transform(x: Array, dt: float, s: float) -> Array:
        i = np.arange(x.size, dtype=float)
        return np.interp(i - s / dt, i, x)

    return Shape("fractional_delay", transform, (1e-6, 0.06), lambda s: {"delay": (s, "s")})


SHAPES: dict[str, Callable[[Rng], Shape]] = {
    "hysteresis": hysteresis,
    "rate_dependent_hysteresis": rate_dependent_hysteresis,
    "creep": creep,
    "backlash": backlash,
    "dead_zone": dead_zone,
    "saturation": saturation,
    "static_nonlinearity": static_nonlinearity,
    "slew_limit": slew_limit,
    "first_order_lag": first_order_lag,
    "ac_coupling": ac_coupling,
    "resonance": resonance,
    "dead_time": dead_time,
}
