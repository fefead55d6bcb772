"""Effects outside the vocabulary: the right answer is 'unexplained', with the signal they follow."""

from __future__ import annotations

import numpy as np

from hal.arrays import Array
from tools.research.prove.forms_memory import Rng
from tools.research.prove.plants import Bound, Flow, Scene
from tools.research.prove.ports import added, main_drive, zero_level

NAME = "unknown"
ANY_STAGE = ("amplifier", "actuator", "sensor", "mounting", "acquisition", "environment", "mechanics")


def _normal(x: Array) -> Array:
    mid = np.mean(x)
    return (x - mid) / max(float(np.max(np.abs(x - mid))), 1e-12)


def _decorrelation(x: Array) -> int:
    """Lag in samples at which x has forgotten most of itself: a shorter one makes the product a plain square."""
    c = x - np.mean(x)
    full = 1 << int(np.ceil(np.log2(2 * c.size)))
    corr = np.fft.irfft(np.abs(np.fft.rfft(c, full)) ** 2)[: c.size // 4]
    below = np.flatnonzero(corr < 0.2 * corr[0])
    return int(below[0]) if below.size else c.size // 8


def gain_follows_context(rng: Rng, scene: Scene, signal: str) -> Bound:
    form = str(rng.choice(["gain_bump", "gain_wave", "gain_valley", "gain_swell"]))
    centre, width, wave_k = rng.uniform(-0.3, 0.3), rng.uniform(0.2, 0.45), rng.uniform(3.0, 5.5)
    out = str(rng.choice(list(scene.outputs)))
    zero = zero_level(scene, out)

    def after(flow: Flow, s: float) -> None:
        h = _normal(flow.context[signal])
        if form == "gain_bump":
            g = np.exp(-(((h - centre) / width) ** 2))
        elif form == "gain_wave":
            g = np.sin(wave_k * h + centre)
        elif form == "gain_valley":
            g = np.abs(h - centre)
        else:
            g = h  # plain amplitude modulation by the recorded signal
        flow.out[out] = flow.out[out] + s * g * (flow.out[out] - zero)

    return Bound(NAME, form, on_out=after, outputs=(out,), stages=ANY_STAGE, depends=(signal,), strength=(1e-6, 0.9))


def offset_follows_context(rng: Rng, scene: Scene, signal: str) -> Bound:
    form = str(rng.choice(["sqrt_abs", "abs", "rectified_square"]))
    out = str(rng.choice(list(scene.outputs)))

    def wave(flow: Flow, key: str) -> Array:
        h = _normal(flow.context[signal])
        if form == "sqrt_abs":
            return np.sqrt(np.abs(h))
        return np.abs(h) if form == "abs" else np.maximum(h, 0.0) ** 2

    return added(NAME, form, scene, (out,), wave, stages=ANY_STAGE, depends=(signal,))


def product_of_history(rng: Rng, scene: Scene) -> Bound:
    key = main_drive(scene)
    x = scene.inputs[key]
    mid, half = 0.5 * (x.max() + x.min()), max(0.5 * float(np.ptp(x)), 1e-12)
    late = _decorrelation(x) * scene.dt * rng.uniform(0.9, 1.3)
    form = str(rng.choice(["product_with_past", "past_square_times_now"]))
    out = str(rng.choice(list(scene.outputs)))

    def wave(flow: Flow, _: str) -> Array:
        now = (flow.drive[key] - mid) / half
        past = np.interp(flow.t - late, flow.t, now)
        return now * past if form == "product_with_past" else now * past**2

    return added(NAME, form, scene, (out,), wave, stages=ANY_STAGE, depends=(key, *scene.outputs))


def context_times_rate(rng: Rng, scene: Scene, signal: str) -> Bound:
    key = main_drive(scene)
    out = str(rng.choice(list(scene.outputs)))

    def wave(flow: Flow, _: str) -> Array:
        r = np.gradient(flow.drive[key])
        return _normal(flow.context[signal]) * r / max(float(np.max(np.abs(r))), 1e-12)

    return added(NAME, "context_times_rate", scene, (out,), wave, stages=ANY_STAGE, depends=(signal, key))


def unknown(rng: Rng, scene: Scene, signal: str | None) -> Bound:
    """One effect outside the vocabulary; ``signal`` is the context that it may follow, if one is recorded."""
    if signal is None:
        return product_of_history(rng, scene)
    pick = rng.random()
    stepped = scene.excitation in ("staircase", "rotary", "slow", "slow3")  # a rate that is zero nearly always
    if pick < 0.6 or (pick >= 0.85 and stepped):
        return gain_follows_context(rng, scene, signal)
    if pick < 0.85:
        return offset_follows_context(rng, scene, signal)
    return context_times_rate(rng, scene, signal)
