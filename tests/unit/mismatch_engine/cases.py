"""Small private recordings: physics written here in other forms than the effects', seeds by number."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from pathlib import Path

import numba
import numpy as np
from scipy.signal import lfilter

from sim_devices.physics.catalogue import EFFECTS
from tools.mismatch.infer import diagnose
from tools.mismatch.infer.borne_out import Out
from tools.mismatch.infer.store import Scored, Store
from tools.mismatch.recording import Recording, Split, TwinText

Array = np.ndarray
RATE = 500.0
N = 6000
UNITS = {"command": "V", "displacement": "um", "temperature": "degC", "load": "N", "force": "N", "position": "m"}


def unit(signal: str) -> str:
    return UNITS.get(signal) or ("g" if signal.startswith("specific") else "V")


def recording(
    kind: str,
    inputs: dict[str, Array],
    outputs: dict[str, Array],
    parameters: dict[str, object],
    *,
    context: dict[str, Array] | None = None,
    noise: dict[str, float] | None = None,
    rate_hz: float = RATE,
    split: Split | None = None,
) -> Recording:
    context = context or {}
    names = (*inputs, *outputs, *context)
    n = next(iter(inputs.values())).size
    return Recording(
        path=Path("made-in-a-test.toml"),
        title="test",
        t=np.arange(n) / rate_hz,
        dt=1 / rate_hz,
        inputs=inputs,
        outputs=outputs,
        context=context,
        noise={o: (noise or {}).get(o) for o in outputs},
        unit={s: unit(s) for s in names},
        column={s: s for s in names},
        twin=TwinText(kind, parameters),
        split=split or Split(),
    )


def wave(rng: np.random.Generator, n: int = N, low: float = 0.4, high: float = 9.0) -> Array:
    """Modulated multi-sine within -1..1."""
    t = np.arange(n) / RATE
    x = np.zeros(n)
    for _ in range(7):
        f = np.exp(rng.uniform(np.log(low), np.log(high)))
        swell = 1 + 0.5 * np.sin(2 * np.pi * rng.uniform(0.05, 0.3) * t + rng.uniform(0, 6))
        x += rng.uniform(0.3, 1) / np.sqrt(f) * swell * np.sin(2 * np.pi * f * t + rng.uniform(0, 6))
    return x / np.max(np.abs(x))


def noise(kind: str, rng: np.random.Generator, n: int = N) -> Array:
    """Unit noise of a kind."""
    white = rng.standard_normal(n)
    if kind == "coloured":
        slow = lfilter([1.0], [1.0, -0.99], rng.standard_normal(n))
        return (white + slow / slow.std()) / np.sqrt(2)
    if kind == "heavy":
        return rng.standard_t(3, n) / np.sqrt(3)
    if kind == "quantised":
        return np.round(white / 0.8) * 0.8 / np.sqrt(1 + 0.8**2 / 12)
    return white


def bouc_wen(u: Array, length: float) -> Array:
    z = np.zeros(u.size)
    for i in range(1, u.size):
        d = (u[i] - u[i - 1]) / length
        z[i] = z[i - 1] + d - 0.5 * abs(d) * z[i - 1] - 0.5 * d * abs(z[i - 1])
    return z


def stack(
    rng: np.random.Generator, effect: str, severity: float, *, kind: str = "white", shift: float = 0.05
) -> Recording:
    """A piezo stack with one effect of the given rms over noise rms after a straight line was taken off."""
    t = np.arange(N) / RATE
    u = 50 + 40 * wave(rng)
    clean = 0.12 * u + 1.0
    v = (u - 50) / 40
    context: dict[str, Array] = {}
    if effect == "hysteresis":
        added = bouc_wen(v, 0.4)
    elif effect == "backlash":
        gap, y = 0.15, np.empty(N)
        y[0] = v[0]
        for i in range(1, N):
            y[i] = min(max(y[i - 1], v[i] - gap), v[i] + gap)
        added = y
    elif effect == "thermal_drift":
        added = 0.7 * np.exp(-t / 3.0) + 0.3 * np.exp(-t / 0.9)
    elif effect == "saturation":
        added = np.minimum(v, 0.35) - v
    elif effect == "mains_interference":
        added = np.sin(2 * np.pi * 50.03 * t) + 0.3 * np.sin(2 * np.pi * 150.09 * t + 1)
    elif effect == "vibration":
        added = np.sin(2 * np.pi * 33.3 * t + 0.4)
    elif effect == "step_shift":
        added = (t > 5.2).astype(float)
    elif effect == "dead_time":
        added = np.interp(t - 0.011, t, v) - v
    elif effect == "first_order_lag":
        added = lfilter([0.12], [1, -0.88], v) - v
    elif effect == "static_nonlinearity":
        added = v**2 - 0.4 * v**3
    elif effect == "spikes":
        added = np.zeros(N)
        for at in rng.integers(200, N - 200, 6):
            added[at : at + 12] += np.hanning(12)
    elif effect == "gain by load":
        load = wave(rng, low=0.1, high=0.6)
        decoy = wave(rng, low=0.1, high=0.6)
        context = {"load": load, "temperature": 25 + decoy}
        added = v * np.tanh(4 * np.abs(load - 0.2))
    else:
        added = np.zeros(N)
    line = np.column_stack([np.ones(N), u])
    left = added - line @ np.linalg.lstsq(line, added, rcond=None)[0]
    size = float(left.std()) or 1.0
    sigma = 0.05
    if effect in ("saturation", "dead_time", "first_order_lag"):
        # these cannot be scaled without becoming something else: the noise is
        sigma = 0.12 * 40 * size / severity
    y = clean + severity * sigma * added / size + sigma * noise(kind, rng)
    gain = 0.12 if shift == 0 else 0.12 * (1 + shift)
    return recording(
        "piezo_stack",
        {"command": u},
        {"displacement": y},
        {"gain_um_per_V": gain, "offset_um": 1.0},
        context=context,
        noise={"displacement": sigma},
    )


def named(made: Recording, names: Iterable[str]) -> set[str]:
    """Return the names that a diagnosis gives where these are the effects that are known."""
    report = diagnose(made, effects=[EFFECTS[n] for n in names], jobs=1)
    return {p.name for p in report.physics}


def among(*sets: Scored) -> Callable[[Store, Sequence[Out]], list[Scored]]:
    """Return what accepts these sets."""
    return lambda store, gone: [s for s in sets if not any(g(s) for g in gone)]


@numba.njit
def swung(u: Array, rate_hz: float, rate_rad_s: float = 30.0, damping: float = 4.0, sway: float = 0.0) -> Array:
    """Return the course (n,) of x'' = u - damping x' - rate^2 (1 + sway cos 90 t) x, in 20 steps a sample."""
    out = np.empty(u.size)
    h = 1.0 / (rate_hz * 20)
    x, v, t = 0.0, 0.0, 0.0
    for k in range(u.size):
        out[k] = x
        for _ in range(20):
            v += h * (u[k] - damping * v - rate_rad_s**2 * (1.0 + sway * np.cos(90.0 * t)) * x)
            x += h * v
            t += h
    return out
