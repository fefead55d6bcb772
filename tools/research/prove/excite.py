"""Excitations: what an engineer would have driven or moved when the recording was made."""

from __future__ import annotations

import numpy as np
from scipy.spatial.transform import Rotation

from hal.arrays import Array

Rng = np.random.Generator


def _smooth_step(x: Array) -> Array:
    x = np.clip(x, 0.0, 1.0)
    return x * x * (3.0 - 2.0 * x)


def levels(t: Array, values: Array, times: Array, rise_s: Array) -> Array:
    """Piecewise constant levels with smooth rises that start at ``times`` (len(values) - 1)."""
    out = np.full(t.shape, values[0])
    for k in range(times.size):
        out += (values[k + 1] - values[k]) * _smooth_step((t - times[k]) / rise_s[k])
    return out


def sine(rng: Rng, t: Array) -> Array:
    return np.sin(2 * np.pi * rng.uniform(1.0, 19.0) * t + rng.uniform(0, 6.28))


def sines(rng: Rng, t: Array) -> Array:
    """Sinusoids of 1 to 19 Hz and different amplitudes one after the other, phase continuous."""
    parts = int(rng.integers(5, 10))
    edges = np.linspace(t[0], t[-1], parts + 1)[1:-1]
    freq = rng.permutation(np.geomspace(1.0, 19.0, parts))
    amp = rng.permutation(np.linspace(0.35, 1.0, parts))
    rise = np.full(parts - 1, 0.2)
    phase = 2 * np.pi * np.cumsum(levels(t, freq, edges, rise)) * (t[1] - t[0])
    return levels(t, amp, edges, rise) * np.sin(phase)


def multisine(rng: Rng, t: Array) -> Array:
    """Modulated multi-sine, 1 to 19 Hz, plus a slow component."""
    x = np.zeros(t.size)
    for f in rng.uniform(1.0, 19.0, int(rng.integers(5, 14))):
        mod = 1.0 + 0.5 * np.sin(2 * np.pi * rng.uniform(0.05, 0.4) * t + rng.uniform(0, 6.28))
        x += f ** rng.uniform(-1.0, -0.2) * mod * np.sin(2 * np.pi * f * t + rng.uniform(0, 6.28))
    x += 0.6 * np.max(np.abs(x)) * np.sin(2 * np.pi * rng.uniform(0.1, 0.5) * t + rng.uniform(0, 6.28))
    return x


def tremor(rng: Rng, t: Array) -> Array:
    """Voluntary motion below 1 Hz and a wandering 8 to 12 Hz tremor."""
    slow = np.zeros(t.size)
    for f in rng.uniform(0.05, 0.8, 4):
        slow += np.sin(2 * np.pi * f * t + rng.uniform(0, 6.28)) / (0.3 + f)
    slow /= np.max(np.abs(slow))
    f0 = rng.uniform(8.0, 12.0)
    wander = rng.uniform(0.3, 1.0) * np.sin(2 * np.pi * rng.uniform(0.05, 0.3) * t + rng.uniform(0, 6.28))
    phase = 2 * np.pi * np.cumsum(f0 + wander) * (t[1] - t[0])
    envelope = 0.6 + 0.4 * np.sin(2 * np.pi * rng.uniform(0.1, 0.5) * t + rng.uniform(0, 6.28))
    return slow + rng.uniform(0.2, 0.6) * envelope * np.sin(phase)


def staircase(rng: Rng, t: Array, hold_s: float | None = None) -> Array:
    """Random levels, each held for some time; rises take 4 to 30 ms (or two samples)."""
    span = t[-1] - t[0]
    hold = hold_s or float(np.clip(span / rng.uniform(9, 22), 0.5, 6.0))
    count = max(int(span / hold), 4)
    times = t[0] + hold * (np.arange(1, count) + rng.uniform(-0.2, 0.2, count - 1))
    values = rng.uniform(-1, 1, count)
    low = np.abs(np.diff(values)) < 0.3
    values[1:][low] *= -1.0
    dt = t[1] - t[0]
    return levels(t, values, times, np.full(count - 1, max(rng.uniform(0.004, 0.03), 2 * dt)))


def sawtooth(rng: Rng, t: Array) -> Array:
    """Triangles of changing height between turning points, slightly rounded by nothing but sampling."""
    span = t[-1] - t[0]
    count = int(np.clip(span * rng.uniform(0.4, 3.0), 12, 400))
    turn = np.concatenate([[t[0]], np.sort(rng.uniform(0.1, 0.9, count) + np.arange(count)) / count * span + t[0]])
    height = rng.uniform(0.2, 1.0, count + 1) * np.where(np.arange(count + 1) % 2 == 0, 1.0, -1.0)
    return np.interp(t, turn, height)


def chirp(rng: Rng, t: Array) -> Array:
    """Sweep 0.3 to 19 Hz, linear or logarithmic, repeated one to four times, amplitude changing."""
    sweeps = int(rng.integers(1, 5))
    span = (t[-1] - t[0]) / sweeps
    frac = ((t - t[0]) / span) % 1.0
    if sweeps > 1:
        up = (((t - t[0]) // span) % 2) == 0
        frac = np.where(up, frac, 1.0 - frac)
    f1 = rng.uniform(12.0, 19.0)
    freq = 0.3 * (f1 / 0.3) ** frac if rng.random() < 0.5 else 0.3 + (f1 - 0.3) * frac
    amp = 0.75 + 0.25 * np.sin(2 * np.pi * (t - t[0]) / span / rng.uniform(1.5, 3.0))
    return amp * np.sin(2 * np.pi * np.cumsum(freq) * (t[1] - t[0]))


def slow(rng: Rng, t: Array) -> Array:
    """Hours: levels held for minutes, with a slow swing on top."""
    span = t[-1] - t[0]
    x = staircase(rng, t, hold_s=span / rng.uniform(12, 30))
    return x + 0.3 * np.sin(2 * np.pi * t / (span / rng.uniform(3, 9)) + rng.uniform(0, 6.28))


SCALAR = {
    "sine": sine,
    "sines": sines,
    "multisine": multisine,
    "tremor": tremor,
    "staircase": staircase,
    "sawtooth": sawtooth,
    "chirp": chirp,
    "slow": slow,
}


def scalar(rng: Rng, kind: str, t: Array) -> Array:
    """One drive signal of shape (n,), largest magnitude one."""
    x = SCALAR[kind](rng, t)
    return x / np.max(np.abs(x))


def _angles(rng: Rng, kind: str, t: Array) -> Array:
    span = t[-1] - t[0]
    if kind in ("rotary", "slow3"):
        count = int(rng.integers(14, 30))
        dwell = span / count
        times = t[0] + dwell * np.arange(1, count)
        rise = np.full(count - 1, max(min(0.3 * dwell, rng.uniform(0.3, 1.2)), 2 * (t[1] - t[0])))
        first = np.cumsum(rng.choice([30.0, 45.0, 60.0, 90.0]) * np.ones(count))
        half = count // 2
        second = np.concatenate([np.zeros(half), np.cumsum(rng.choice([30.0, 45.0, 90.0]) * np.ones(count - half))])
        third = np.concatenate([np.zeros(count // 3), 35.0 * np.ones(count - count // 3)])
        cols = [levels(t, np.deg2rad(v), times, rise) for v in (third, first, second)]
        return np.stack([cols[i] for i in rng.permutation(3)], axis=1)
    out = np.zeros((t.size, 3))
    scale = 1.0 if kind == "tumble" else 0.25
    for axis_index in range(3):
        for f in rng.uniform(0.02, 0.35, 4):
            out[:, axis_index] += rng.uniform(0.5, 1.4) * np.sin(2 * np.pi * f * t + rng.uniform(0, 6.28))
    return scale * out + rng.uniform(-2, 2, 3)


def turning(rng: Rng, kind: str, t: Array, world: Array) -> Array:
    """A fixed world vector seen from a turning body, shape (n, 3). Kinds: rotary, slow3, tumble, shake3, ..."""
    body = Rotation.from_euler("zyx", _angles(rng, kind, t))
    return body.inv().apply(world)


def shaking(rng: Rng, kind: str, t: Array) -> Array:
    """Independent vibration of three axes, each within one, shape (n, 3)."""
    base = {"shake3": "multisine", "tremor3": "tremor", "chirp3": "chirp"}[kind]
    return np.stack([scalar(rng, base, t) for _ in range(3)], axis=1)


def smooth_vector(rng: Rng, t: Array, band_hz: tuple[float, float], count: int) -> tuple[Array, Array]:
    """Sum of sinusoids per axis and its exact time derivative, both (n, 3), rms one per axis."""
    x = np.zeros((t.size, 3))
    dx = np.zeros((t.size, 3))
    for k in range(3):
        for f in rng.uniform(*band_hz, count):
            ph = rng.uniform(0, 6.28)
            x[:, k] += np.sin(2 * np.pi * f * t + ph)
            dx[:, k] += 2 * np.pi * f * np.cos(2 * np.pi * f * t + ph)
        s = np.std(x[:, k])
        x[:, k] /= s
        dx[:, k] /= s
    return x, dx


def context(rng: Rng, kind: str, t: Array) -> Array:
    """A signal recorded beside: 'ambient', 'cycled', 'steps' or 'ripple'; zero mean, largest magnitude one."""
    span = t[-1] - t[0]
    if kind == "cycled":
        x = np.sin(2 * np.pi * t / span * rng.uniform(1.5, 5.0) + rng.uniform(0, 6.28))
        x += 0.3 * np.sin(2 * np.pi * t / span * rng.uniform(5.0, 11.0) + rng.uniform(0, 6.28))
    elif kind == "steps":
        x = staircase(rng, t, hold_s=span / rng.uniform(6, 14))
    elif kind == "ripple":
        x = np.zeros(t.size)
        for f in rng.uniform(3.0, 60.0, 7) / span:
            x += np.sin(2 * np.pi * f * t + rng.uniform(0, 6.28))
    else:
        x = np.zeros(t.size)
        for f in rng.uniform(0.4, 6.0, 6) / span:
            x += np.sin(2 * np.pi * f * t + rng.uniform(0, 6.28)) / f / span
    x = x - np.mean(x)
    return x / np.max(np.abs(x))
