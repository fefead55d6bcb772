"""Creep: slow relaxation after a change of input, as a spread of relaxation modes."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from sim_devices.physics.effect import Array, Context, Effect, Human, Parameter, Parts, Settings
from sim_devices.physics.lag import low_pass


def time_constants(dt: float, span: float) -> tuple[float, ...]:
    """Return time constants, about two per decade, from five samples (or span / 3000) to twice the span."""
    lo, hi = max(5 * dt, span / 3000), 2 * span
    n = int(np.clip(np.ceil(2 * np.log10(hi / lo)) + 1, 4, 10))
    return tuple(float(t) for t in np.geomspace(lo, hi, n))


def modes(x: Array, dt: float, taus: Sequence[float], rest: float, starts: tuple[int, ...]) -> Array:
    """Return the relaxation (n, modes) of each mode towards x from ``rest``: tau z' = x - z, z(start) = rest."""
    at = np.array(starts)
    out = np.empty((len(taus), x.size))
    for j, tau in enumerate(taus):
        out[j] = low_pass(x, dt, tau, at)
        for a, b in zip(starts, (*starts[1:], x.size), strict=True):
            # e^-45 is nothing beside one
            felt = min(b, a + int(45 * tau / dt) + 2)
            out[j, a:felt] += (rest - x[a]) * np.exp(-np.arange(felt - a) * (dt / tau))
    return out.T


def _prepare(x: Array, residual: Array, ctx: Context) -> Settings:
    lo, hi = float(x.min()), float(x.max())
    return {
        "time_constants_s": time_constants(ctx.dt, ctx.dt * ctx.t.size),
        "rest_range": (min(lo, 0.0), max(hi, 0.0) if max(hi, 0.0) > min(lo, 0.0) else min(lo, 0.0) + 1.0),
        "first": (float(x[0]),),
    }


def _parts(settings: Settings) -> Parts:
    taus = settings.get("time_constants_s", (0.1, 1.0, 10.0))
    lo, hi = settings.get("rest_range", (-1.0, 1.0))
    n = len(taus)
    bend = np.diff(np.eye(n), 2, axis=0) if n > 2 else np.zeros((0, n))
    return Parts(
        (Parameter("rest", "{in}", lo, hi, scale=0.05 * (hi - lo)),),
        tuple(Parameter(f"c{i + 1}", "{out}/{in}", scale=0.02) for i in range(n)),
        np.concatenate([0.05 * np.eye(n), 0.1 * bend]),
    )


def _basis(x: Array, ctx: Context, q: Array, settings: Settings) -> Array:
    return modes(x, ctx.dt, settings.get("time_constants_s", (0.1, 1.0, 10.0)), q[0], ctx.starts)


def _guess(x: Array, residual: Array, ctx: Context, settings: Settings) -> Sequence[Sequence[float]]:
    lo, hi = settings["rest_range"]
    zero = float(np.clip(0.0, lo, hi))
    return tuple((v,) for v in dict.fromkeys((settings["first"][0], zero, float(np.mean(x[ctx.keep])))))


def per_decade(p: Array, taus: Sequence[float], scale: float, decades: tuple[float, float]) -> float:
    """Return the mean rise per decade of time of the response to a unit step, relative to ``scale``."""
    t = np.array([10.0 ** decades[0], 10.0 ** decades[1]])
    rise = (1 - np.exp(-t[:, None] / np.array(taus))) @ p
    return float((rise[1] - rise[0]) / max(decades[1] - decades[0], 1e-9) / scale) if scale else 0.0


def _report(p: Array, settings: Settings, scale: float) -> Sequence[Human]:
    taus = settings["time_constants_s"]
    w = p[1:]
    lo, hi = np.log10(taus[0]), np.log10(taus[-1] / 2)
    # the gain that one sees at once is the base gain; creep comes on top
    rise = (1 - np.exp(-(10.0**hi) / np.array(taus))) @ w
    size = np.abs(w)
    middle = float(np.exp(np.sum(size * np.log(taus)) / np.sum(size))) if np.sum(size) > 0 else 0.0
    return (
        Human("fraction_per_decade", per_decade(w, taus, scale, (float(lo), float(hi))), "1"),
        Human("total_fraction", float(rise / scale) if scale else 0.0, "1"),
        Human("mean_time_constant_s", middle, "s"),
    )


CREEP = Effect(
    name="creep",
    summary="slow relaxation after a change of input, about logarithmic in time",
    kind="add",
    stages=("actuator", "sensor", "mechanics"),
    parts=_parts,
    equation=r"y = x + \sum_j c_j z_j,\quad \tau_j \dot z_j = x - z_j",
    source="H. Janocha, K. Kuhnen, Sensors and Actuators A 79 (2000) 83, eq. 6; W. N. Findley et al., Creep and"
    " Relaxation of Nonlinear Viscoelastic Materials, ch. 5 (Kelvin chain)",
    excitation="steps or changes of the mean, with minutes to settle; several of both signs tell it from warm-up",
    confusable_with=("thermal_drift", "first_order_lag", "hysteresis", "ac_coupling"),
    proportional=True,
    prepare=_prepare,
    guess=_guess,
    basis=_basis,
    report=_report,
    # minus one is a mean that is lost (ac_coupling), several times the response at once is a lag
    limits={"total_fraction": (-0.8, 1.5)},
    vanishes_with=(("fraction_per_decade", "total_fraction"),),
)
