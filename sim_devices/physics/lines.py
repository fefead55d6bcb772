"""Periodic disturbances: mains hum and vibration, with amplitude and phase that may wander."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from sim_devices.physics.effect import Array, Context, Effect, Human, Parameter, Parts, Settings


def tones(t: Array, frequency: float, harmonics: int) -> Array:
    """Sine and cosine of each harmonic, (n, 2 * harmonics)."""
    phase = 2 * np.pi * frequency * t
    cols = [f(h * phase) for h in range(1, harmonics + 1) for f in (np.sin, np.cos)]
    return np.stack(cols, axis=1)


def _prepare(x: Array, residual: Array, ctx: Context) -> Settings:
    nyquist = 0.5 / ctx.dt
    f0, best = 50.0, -1.0
    r = residual - residual.mean()
    for f in (50.0, 60.0):
        if f < nyquist:
            c = tones(ctx.t, f, 1)
            power = float(np.sum((c.T @ r) ** 2))
            if power > best:
                f0, best = f, power
    harmonics = int(max(1, min(5, 0.9 * nyquist // f0)))
    return {"nominal": (f0,), "harmonics": (float(harmonics),), "span": (ctx.dt * ctx.t.size,)}


def _parts(settings: Settings) -> Parts:
    f0 = settings.get("nominal", (50.0,))[0]
    n = int(settings.get("harmonics", (1.0,))[0])
    span = settings.get("span", (1.0,))[0]
    names = [f"{p}{h}" for h in range(1, n + 1) for p in ("sin", "cos")]
    return Parts(
        (Parameter("frequency_Hz", "Hz", 0.99 * f0, 1.01 * f0, scale=0.1 / span),),
        tuple(Parameter(m, "{out}", scale=1.0) for m in names),
    )


def _basis(x: Array, ctx: Context, q: Array, settings: Settings) -> Array:
    return tones(ctx.t, q[0], int(settings.get("harmonics", (1.0,))[0]))


def _guess(x: Array, residual: Array, ctx: Context, settings: Settings) -> Sequence[Sequence[float]]:
    f0 = settings["nominal"][0]
    span = settings["span"][0]
    grid = np.arange(0.99 * f0, 1.01 * f0, 0.25 / span)[:4000]
    r = residual - residual.mean()
    power = [float(np.sum((tones(ctx.t, f, 1).T @ r) ** 2)) for f in grid]
    return ((float(grid[int(np.argmax(power))]),),)


def _report(p: Array, settings: Settings, scale: float) -> Sequence[Human]:
    amplitudes = np.hypot(p[1::2], p[2::2])
    return (
        Human("frequency_Hz", float(p[0]), "Hz"),
        *(Human(f"amplitude_{h + 1}", float(a), "{out}") for h, a in enumerate(amplitudes)),
    )


MAINS_INTERFERENCE = Effect(
    name="mains_interference",
    summary="50 or 60 Hz and harmonics",
    kind="add",
    stages=("acquisition", "environment"),
    parts=_parts,
    equation=r"y = x + \sum_h a_h \sin 2\pi h f t + b_h \cos 2\pi h f t",
    source="H. W. Ott, Electromagnetic Compatibility Engineering, chapters 2-3; IEC 61000-4-7 for harmonics",
    excitation="a sampling rate above 100 Hz",
    confusable_with=("vibration",),
    prepare=_prepare,
    guess=_guess,
    basis=_basis,
    report=_report,
    driven=False,
    sites=("output",),
)
