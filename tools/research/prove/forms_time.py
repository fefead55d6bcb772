"""Effects that do not come from the input: drifts, lines, bursts, steps, clocks and lost samples."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from scipy.interpolate import CubicSpline
from scipy.signal import lfilter

from hal.arrays import Array
from tools.research.prove.forms_memory import Rng
from tools.research.prove.plants import Bound, Flow, Scene, Signals
from tools.research.prove.ports import added, pick_outputs, spans

ANYWHERE = ("sensor", "environment", "acquisition", "amplifier", "mechanics", "mounting", "actuator")


def thermal_drift(rng: Rng, scene: Scene) -> Bound:
    form = str(rng.choice(["one_exponential", "two_exponentials", "logistic", "unknown_start"]))
    span = scene.t[-1] - scene.t[0]
    tau = span * rng.uniform(0.12, 0.6)
    second = tau * rng.uniform(0.1, 0.3)
    share = rng.uniform(0.25, 0.6)
    centre = span * rng.uniform(0.15, 0.4)
    gain_share = float(rng.choice([0.0, 0.0, 0.2]))

    def wave(flow: Flow, key: str) -> Array:
        t = flow.t - flow.t[0]
        if form == "two_exponentials":
            w = 1.0 - (1 - share) * np.exp(-t / tau) - share * np.exp(-t / second)
        elif form == "logistic":
            w = 1.0 / (1.0 + np.exp(-(t - centre) / (0.35 * centre)))
        elif form == "unknown_start":
            w = 1.0 - np.exp(-(t + 0.4 * tau) / tau)
        else:
            w = 1.0 - np.exp(-t / tau)
        if gain_share:
            y = flow.out[key]
            w = w * (1.0 + gain_share * (y - np.mean(y)) / max(float(np.ptp(y)), 1e-12))
        return w

    truth = (lambda s: {"time_constant": (tau, "s")}) if form in ("one_exponential", "unknown_start") else None
    return added("thermal_drift", form, scene, pick_outputs(rng, scene, False), wave, stages=ANYWHERE, truth=truth)


def _mean_hz(turns: Callable[[Array], Array], scene: Scene) -> float:
    """Mean frequency over the record of a line of this phase: what a recording can tell of one that wanders."""
    phase = turns(scene.t[: scene.keep])
    return float(phase[-1] - phase[0]) / (2 * np.pi * (scene.keep - 1) * scene.dt)


def mains_interference(rng: Rng, scene: Scene) -> Bound:
    form = str(rng.choice(["steady", "wandering", "harmonics"]))
    base = float(rng.choice([50.0, 60.0]))
    amps = np.array([1.0, rng.uniform(0.0, 0.3), rng.uniform(0.1, 0.5)]) if form == "harmonics" else np.array([1.0])
    phases = rng.uniform(0, 6.28, 3)
    detune = 0.0 if form == "steady" else rng.uniform(-0.03, 0.03)
    swing, rate, breathe = rng.uniform(0.2, 1.2), rng.uniform(0.02, 0.08), rng.uniform(0.05, 0.25)

    def turns(t: Array) -> Array:
        ph = 2 * np.pi * (base + detune) * t
        return ph if form == "steady" else ph + swing * np.sin(2 * np.pi * rate * t + phases[0])

    def wave(flow: Flow, key: str) -> Array:
        t = flow.t
        ph = turns(t)
        env = np.ones(t.size)
        if form != "steady":
            env = 1.0 + breathe * np.sin(2 * np.pi * 1.3 * rate * t + phases[1])
        w = np.zeros(t.size)
        for k, a in enumerate(amps):
            if (k + 1) * base < 0.5 / scene.dt:
                w += a * np.sin((k + 1) * ph + phases[k])
        return env * w

    return added(
        "mains_interference",
        form,
        scene,
        pick_outputs(rng, scene, False),
        wave,
        stages=ANYWHERE,
        truth=lambda s: {"frequency": (_mean_hz(turns, scene), "Hz")},
    )


def vibration(rng: Rng, scene: Scene) -> Bound:
    form = str(rng.choice(["steady", "modulated", "decaying", "slow_wander"]))
    top = 0.42 / scene.dt
    while True:
        f = float(np.exp(rng.uniform(np.log(22.0), np.log(max(top, 30.0)))))
        if min(abs(f - k) for k in (50, 60, 100, 120, 150, 180)) > 2.5 and f < 0.45 / scene.dt:
            break
    phase, m, mf = rng.uniform(0, 6.28), rng.uniform(0.3, 0.9), rng.uniform(0.05, 0.3)
    tau = (scene.t[-1] - scene.t[0]) * rng.uniform(0.3, 0.8)

    def turns(t: Array) -> Array:
        ph = 2 * np.pi * f * t + phase
        return ph + 1.5 * np.sin(2 * np.pi * 0.3 * mf * t) if form == "slow_wander" else ph

    def wave(flow: Flow, key: str) -> Array:
        t = flow.t - flow.t[0]
        ph = turns(t)
        env = np.ones(t.size)
        if form == "modulated":
            env = 1.0 + m * np.sin(2 * np.pi * mf * t + 1.0)
        elif form == "decaying":
            env = np.exp(-t / tau)
        return env * np.sin(ph)

    return added(
        "vibration",
        form,
        scene,
        pick_outputs(rng, scene, False),
        wave,
        stages=ANYWHERE,
        truth=lambda s: {"frequency": (_mean_hz(lambda t: turns(t - t[0]), scene), "Hz")},
    )


def spikes(rng: Rng, scene: Scene) -> Bound:
    form = str(rng.choice(["half_sine", "exponential", "doublet", "mixed_sign"]))
    span = scene.t[-1] - scene.t[0]
    width = max(rng.uniform(0.004, 0.03), 2.0 * scene.dt)
    count = int(np.clip(span / rng.uniform(2.0, 6.0), 4, 40))
    at = np.sort(rng.uniform(0.02, 0.97, count)) * span
    size = rng.uniform(0.5, 1.5, count)
    if form == "mixed_sign":
        size *= rng.choice([-1.0, 1.0], count)

    def wave(flow: Flow, key: str) -> Array:
        t = flow.t - flow.t[0]
        w = np.zeros(t.size)
        for a, k in zip(at, size, strict=True):
            r = (t - a) / width
            if form == "exponential":
                w += k * np.where(r > 0, np.exp(-3 * np.maximum(r, 0)), 0.0)
            elif form == "doublet":
                w += k * np.where((r > 0) & (r < 1), np.sin(2 * np.pi * r), 0.0)
            else:
                w += k * np.where((r > 0) & (r < 1), np.sin(np.pi * r), 0.0)
        return w

    return added(
        "spikes",
        form,
        scene,
        pick_outputs(rng, scene, False),
        wave,
        stages=ANYWHERE,
        truth=None,
        predictable=False,
    )


def step_shift(rng: Rng, scene: Scene) -> Bound:
    form = str(rng.choice(["one", "several", "slow_rise"]))
    span = scene.t[-1] - scene.t[0]
    count = 1 if form != "several" else int(rng.integers(2, 4))
    at = (np.arange(count) + rng.uniform(0.25, 0.75, count)) / count * span
    size = rng.choice([-1.0, 1.0], count) * rng.uniform(0.6, 1.0, count)
    rise = rng.uniform(0.002, 0.01) * (4.0 if form == "slow_rise" else 1.0)

    def wave(flow: Flow, key: str) -> Array:
        t = flow.t - flow.t[0]
        w = np.zeros(t.size)
        for a, k in zip(at, size, strict=True):
            w += k * np.clip((t - a) / max(rise, scene.dt), 0.0, 1.0)
        return w

    return added(
        "step_shift",
        form,
        scene,
        pick_outputs(rng, scene, False),
        wave,
        stages=ANYWHERE,
        truth=(lambda s: {"time": (float(at[0]), "s")}) if count == 1 else None,
        predictable=False,
    )


def random_walk(rng: Rng, scene: Scene) -> Bound:
    form = str(rng.choice(["integrated_white", "long_memory"]))
    steps = rng.normal(size=scene.t.size)
    tau = (scene.t[-1] - scene.t[0]) * rng.uniform(2.0, 5.0)

    def wave(flow: Flow, key: str) -> Array:
        if form == "integrated_white":
            w = np.cumsum(steps)
        else:
            w = np.asarray(lfilter([1.0], [1.0, -np.exp(-scene.dt / tau)], steps))
        w = w / np.std(w)
        return np.interp(flow.t, scene.t, w)

    return added(
        "random_walk",
        form,
        scene,
        pick_outputs(rng, scene, True),
        wave,
        stages=ANYWHERE,
        predictable=False,
    )


def clock_skew(rng: Rng, scene: Scene) -> Bound:
    form = str(rng.choice(["constant", "drifting"]))
    sign = float(rng.choice([-1.0, 1.0]))
    change = rng.uniform(0.2, 0.6) if form == "drifting" else 0.0

    def clock(flow: Flow, s: float) -> None:
        t = flow.t - flow.t[0]
        span = t[-1]
        skew = sign * s * 1e-6
        warped = t + skew * (t * (1 - change) + change * t**2 / span)
        for k in scene.outputs:
            y = flow.out[k]
            flow.out[k] = CubicSpline(t, y)(np.clip(warped, 0, span)) if t.size < 1_000_000 else np.interp(warped, t, y)

    return Bound(
        "clock_skew",
        form,
        on_clock=clock,
        outputs=scene.outputs,
        stages=("acquisition", "sensor"),
        depends=("time", *scene.inputs, *scene.outputs),
        strength=(0.5, 3.0e4),
        truth=(lambda s: {"skew": (sign * s, "ppm")}) if form == "constant" else None,
    )


def dropped_samples(rng: Rng, scene: Scene) -> Bound:
    form = str(rng.choice(["single", "bursts", "repeated", "both"]))
    count = int(rng.integers(2, 7))
    at = np.sort(rng.uniform(0.05, 0.85, count))
    weight = rng.uniform(0.5, 1.0, count)
    # all lost or all repeated in one record, except in 'both'
    sign = np.ones(count) if form in ("single", "bursts") else -np.ones(count)
    if form == "both":
        sign[rng.random(count) < 0.7] = 1.0

    def lose(samples: Signals, s: float) -> Signals:
        n = next(iter(samples.values())).size
        index = np.arange(n)
        for a, w, g in zip(at[::-1], weight[::-1], sign[::-1], strict=True):
            k = int(a * scene.keep)
            m = max(round(s * w), 1)
            if g > 0:
                index = np.concatenate([index[:k], index[k + m :]])
            else:
                index = np.concatenate([index[:k], np.full(m, index[k]), index[k:]])
        index = index[: scene.keep] if index.size >= scene.keep else np.pad(index, (0, scene.keep - index.size), "edge")
        return {k: v[index] for k, v in samples.items()}

    return Bound(
        "dropped_samples",
        form,
        on_samples=lose,
        outputs=scene.outputs,
        stages=("acquisition",),
        depends=("time", *scene.inputs, *scene.outputs),
        strength=(1.0, max(0.015 * scene.keep / count, 2.0)),
        predictable=False,
    )


def quantization(rng: Rng, scene: Scene) -> Bound:
    form = str(rng.choice(["rounded", "truncated"]))
    outs = scene.outputs
    span_of = spans(scene)
    shift = rng.uniform(0, 1)

    def step(samples: Signals, s: float) -> Signals:
        done = dict(samples)
        for k in outs:
            q = s * span_of[k].half
            y = samples[k] / q + shift
            done[k] = (np.round(y) if form == "rounded" else np.floor(y) + 0.5) * q - shift * q
        return done

    return Bound(
        "quantization",
        form,
        on_samples=step,
        with_noise=True,
        outputs=outs,
        stages=("acquisition", "sensor"),
        depends=scene.outputs + tuple(scene.inputs),
        strength=(1e-4, 1.5),
        truth=(lambda s: {"step": (s * span_of[outs[0]].half, "output")}) if len(outs) == 1 else None,
        predictable=False,
    )


def channel_delay(rng: Rng, scene: Scene) -> Bound:
    late = str(rng.choice(list(scene.outputs)))

    def clock(flow: Flow, s: float) -> None:
        flow.out[late] = np.interp(flow.t - s, flow.t, flow.out[late])

    return Bound(
        "channel_delay",
        "fractional",
        on_clock=clock,
        outputs=(late,),
        stages=("acquisition", "sensor"),
        depends=tuple(scene.inputs) + scene.outputs,
        strength=(1e-6, 0.06),
        truth=lambda s: {"delay": (s, "s")},
    )
