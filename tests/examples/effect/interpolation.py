"""Interpolation error of an incremental encoder or interferometer: periodic in what it reads.

Unequal sine and cosine signals turn the phase 2 pi x / p into one that is off by a periodic part, mostly its first
harmonic. ``x`` comes before the base's gain, so that lengths of x are in its unit.
"""

from collections.abc import Sequence

import numpy as np

from sim_devices.physics.effect import Array, Context, Effect, Human, Parameter, Parts, Settings


def _parts(settings: Settings) -> Parts:
    lo, hi = settings.get("range", (1e-6, 1.0))
    period = Parameter("period", "{in}", lo, hi, log=True, scale=1e-4 * hi)
    return Parts((period,), (Parameter("sin1", "{out}"), Parameter("cos1", "{out}")))


def _prepare(x: Array, residual: Array, ctx: Context) -> Settings:
    """Periods from the travel down to what the samples can show: ten of them in one."""
    step = float(np.median(np.abs(np.diff(x)))) or 1e-6
    return {"range": (10.0 * step, float(np.ptp(x)) or 1.0)}


def _basis(x: Array, ctx: Context, q: Array, settings: Settings) -> Array:
    phase = 2.0 * np.pi * x / q[0]
    return np.stack([np.sin(phase), np.cos(phase)], axis=1)


def _guess(x: Array, residual: Array, ctx: Context, settings: Settings) -> Sequence[Sequence[float]]:
    """The periods at which the residual has most in common with a sine of x."""
    lo, hi = settings["range"]
    periods = hi / np.arange(1.0, min(hi / lo, 400.0), 0.2)
    rest = np.where(ctx.keep, residual - residual[ctx.keep].mean(), 0.0)
    power = [abs(np.vdot(np.exp(2j * np.pi * x / p), rest)) for p in periods]
    return [(float(periods[i]),) for i in np.argsort(power)[::-1][:3]]


def _report(p: Array, settings: Settings, scale: float) -> Sequence[Human]:
    amplitude = float(np.hypot(p[1], p[2]))
    return (Human("period", float(p[0]) * abs(scale), "{out}"), Human("amplitude", amplitude, "{out}"))


INTERPOLATION_ERROR = Effect(
    name="interpolation_error",
    summary="periodic error of an encoder's interpolation",
    kind="add",
    stages=("sensor",),
    sites=("output",),
    parts=_parts,
    prepare=_prepare,
    basis=_basis,
    guess=_guess,
    report=_report,
    equation=r"y = x + a \sin(2\pi x/p) + b \cos(2\pi x/p)",
    source="P. L. M. Heydemann, Applied Optics 20 (1981) 3382, equations (1) to (4)",
    excitation="slow travel over several periods",
    confusable_with=("static_nonlinearity",),
)
