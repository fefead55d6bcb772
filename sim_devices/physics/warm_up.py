"""Warm-up: slow change with time alone, at once as a machine is switched on, or late as heat soaks through."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from sim_devices.physics.effect import Array, Basis, Context, Effect, Human, Parameter, Parts, Settings, time_settings
from sim_devices.physics.statistics import best_starts, thin


def _warm_parts(settings: Settings) -> Parts:
    dt, span = settings.get("time", (1e-3, 1.0))
    return Parts(
        (
            Parameter("time_constant_s", "s", max(20 * dt, 2e-3 * span), 3 * span, log=True, scale=0.1 * span),
            Parameter("ratio", "1", 0.02, 0.5, log=True, scale=0.1),
        ),
        (Parameter("slow", "{out}"), Parameter("fast", "{out}")),
        np.diag([0.01, 0.05]),
    )


def _warm_basis(x: Array, ctx: Context, q: Array, settings: Settings) -> Array:
    return np.stack([np.exp(-ctx.t / q[0]), np.exp(-ctx.t / (q[0] * q[1]))], axis=1)


def _warm_guess(x: Array, residual: Array, ctx: Context, settings: Settings) -> Sequence[Sequence[float]]:
    p = _warm_parts(settings).nonlinear[0]
    taus = np.geomspace(1.05 * p.lo, 0.95 * p.hi, 14).tolist()
    return _best(_warm_basis, [(tau, ratio) for tau in taus for ratio in (0.05, 0.2)], x, residual, ctx)[:3]


def _best(
    basis: Basis, candidates: Sequence[tuple[float, ...]], x: Array, residual: Array, ctx: Context
) -> list[tuple[float, ...]]:
    k = thin(ctx.keep, 4000)
    return best_starts(candidates, lambda q: basis(x, ctx, np.array(q), {})[k], ctx.line(x, k), residual[k])


def _warm_report(p: Array, settings: Settings, scale: float) -> Sequence[Human]:
    span = settings["time"][1]
    t = np.array([0.0, span])
    change = p[2] * np.exp(-t / p[0]) + p[3] * np.exp(-t / (p[0] * p[1]))
    return (
        Human("drift_over_record", float(change[1] - change[0]), "{out}"),
        Human("time_constant_s", float(p[0] if abs(p[2]) >= abs(p[3]) else p[0] * p[1]), "s"),
        Human("slow_amplitude", float(-p[2]), "{out}"),
        Human("fast_amplitude", float(-p[3]), "{out}"),
    )


def _late_parts(settings: Settings) -> Parts:
    span = settings.get("time", (1e-3, 1.0))[1]
    return Parts(
        (
            Parameter("middle_s", "s", -0.2 * span, 1.2 * span, scale=0.1 * span),
            Parameter("width_s", "s", 0.025 * span, 0.5 * span, log=True, scale=0.05 * span),
        ),
        (Parameter("rise", "{out}"),),
    )


def _late_basis(x: Array, ctx: Context, q: Array, settings: Settings) -> Array:
    return 0.5 * (1.0 + np.tanh(0.5 * (ctx.t - q[0]) / q[1]))[:, None]


def _late_guess(x: Array, residual: Array, ctx: Context, settings: Settings) -> Sequence[Sequence[float]]:
    span = settings["time"][1]
    middles = (np.linspace(0.0, 1.0, 11) * span).tolist()
    grid = [(middle, width) for middle in middles for width in (0.04 * span, 0.12 * span)]
    return _best(_late_basis, grid, x, residual, ctx)[:2]


def _late_report(p: Array, settings: Settings, scale: float) -> Sequence[Human]:
    return (
        Human("drift_over_record", float(p[2]), "{out}"),
        Human("middle_s", float(p[0]), "s"),
        Human("time_constant_s", float(p[1]), "s"),
        Human("share_of_record", float(p[1] / settings["time"][1]), "1"),
    )


def _one_parts(settings: Settings) -> Parts:
    both = _warm_parts(settings)
    return Parts(both.nonlinear[:1], both.weights[:1])


def _one_basis(x: Array, ctx: Context, q: Array, settings: Settings) -> Array:
    return np.exp(-ctx.t / q[0])[:, None]


def _one_guess(x: Array, residual: Array, ctx: Context, settings: Settings) -> Sequence[Sequence[float]]:
    p = _warm_parts(settings).nonlinear[0]
    grid = [(tau,) for tau in np.geomspace(1.05 * p.lo, 0.95 * p.hi, 14).tolist()]
    return _best(_one_basis, grid, x, residual, ctx)[:2]


def _one_report(p: Array, settings: Settings, scale: float) -> Sequence[Human]:
    span = settings["time"][1]
    return (
        Human("drift_over_record", float(p[1] * np.expm1(-span / p[0])), "{out}"),
        Human("time_constant_s", float(p[0]), "s"),
        Human("slow_amplitude", float(-p[1]), "{out}"),
    )


_TWO = Effect(
    name="thermal_drift",
    summary="warm-up: slow, exponential-like, no temperature recorded",
    kind="add",
    stages=("environment", "sensor", "acquisition"),
    parts=_warm_parts,
    equation=r"y = x + a\,e^{-t/\tau} + b\,e^{-t/(r\tau)}",
    source="F. P. Incropera et al., Fundamentals of Heat and Mass Transfer, 6th ed., eq. 5.6 (lumped capacitances)",
    excitation="a record of a time constant or more, from switch-on",
    confusable_with=("creep", "random_walk", "temperature_sensitivity"),
    prepare=time_settings,
    guess=_warm_guess,
    basis=_warm_basis,
    report=_warm_report,
    driven=False,
    sites=("output",),
    vanishes_with=(("drift_over_record", "slow_amplitude", "fast_amplitude"),),
)


_LATE = replace(
    _TWO,
    summary="warm-up that sets in late: slow, then faster, then settled (logistic)",
    parts=_late_parts,
    equation=r"y = x + a / (1 + e^{-(t - t_0)/w})",
    source="H. S. Carslaw, J. C. Jaeger, Conduction of Heat in Solids, 2nd ed., section 3.4 (heat that soaks through a"
    " slab sets in late), with the logistic curve for its shape",
    excitation="none; a record several times as long as the warm-up",
    confusable_with=("step_shift", "random_walk"),
    guess=_late_guess,
    basis=_late_basis,
    report=_late_report,
    # what rises within a fifth of the record (4.4 widths from a tenth to nine) is a step
    limits={"share_of_record": (0.05, np.inf)},
    vanishes_with=(("drift_over_record",),),
)


def _drive_parts(settings: Settings) -> Parts:
    both = _warm_parts(settings)
    return Parts(both.nonlinear[:1], (Parameter("slow", "{in}"),))


def _drive_report(p: Array, settings: Settings, scale: float) -> Sequence[Human]:
    # a weight at an input carries the gain of the base physics
    own = np.array([p[0], p[1] / (scale or 1.0)])
    return tuple(Human(h.name, h.value, h.unit.replace("out", "in")) for h in _one_report(own, settings, scale))


_OF_A_DRIVE = replace(
    _TWO,
    summary="warm-up of a drive: an offset of the input that settles with time",
    stages=("amplifier", "actuator"),
    parts=_drive_parts,
    equation=r"u = x + a\,e^{-t/\tau}",
    guess=_one_guess,
    basis=_one_basis,
    report=_drive_report,
    sites=("input",),
)

# two exponentials fitted to one leave both times loose: the simplest that serves has the interval that holds
THERMAL_DRIFT = replace(
    _TWO,
    parts=_one_parts,
    equation=r"y = x + a\,e^{-t/\tau}",
    guess=_one_guess,
    basis=_one_basis,
    report=_one_report,
    variants=(_TWO, _LATE, _OF_A_DRIVE),
)
