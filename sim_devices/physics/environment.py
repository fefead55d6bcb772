"""Effects of recorded conditions on a reading: temperature, supply voltage, actuator current."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from functools import partial

import numpy as np

from sim_devices.physics.effect import Array, Context, Effect, Human, Parameter, Parts, Settings
from sim_devices.physics.lag import low_pass
from sim_devices.physics.statistics import least_squares, thin


def _varies(name: str, signals: Mapping[str, Array], output: str) -> str:
    if name not in signals:
        return f"{name} not recorded"
    return "" if float(np.ptp(signals[name])) > 0 else f"{name} never changes"


# -- temperature ------------------------------------------------------------------------------------


def _prepare(signal: str, x: Array, residual: Array, ctx: Context) -> Settings:
    k = ctx.keep
    v = ctx.signals[signal][k]
    moving = float(np.ptp(x[k])) > 0
    return {
        "reference": (float(v.mean()),),
        "spread": (float(v.std()) or 1.0,),
        "centre": (float(x[k].mean()),),
        "gain": (1.0 if moving else 0.0,),
        "time": (ctx.dt, ctx.dt * ctx.t.size),
    }


def _parts(unit: str, lag: str, settings: Settings) -> Parts:
    dt, span = settings.get("time", (1e-3, 1.0))
    weights = [Parameter(f"bias_per_{unit}", f"{{out}}/{unit}"), Parameter(f"bias_per_{unit}2", f"{{out}}/{unit}^2")]
    if settings.get("gain", (1.0,))[0]:
        weights.append(Parameter(f"scale_per_{unit}", f"{{out}}/({{in}} {unit})"))
    return Parts(
        (Parameter(lag, "s", 0.01 * dt, 0.3 * span, log=True, scale=dt),),
        tuple(weights),
        np.diag([0.02, 0.1, 0.02][: len(weights)]),
    )


def _basis(signal: str, x: Array, ctx: Context, q: Array, settings: Settings) -> Array:
    d = ctx.signals[signal] - settings.get("reference", (0.0,))[0]
    if q[0] > 0.1 * ctx.dt:
        d = low_pass(np.ascontiguousarray(d), ctx.dt, q[0], np.array(ctx.starts))
    cols = [d, d * d]
    if settings.get("gain", (1.0,))[0]:
        # about the middle of the input range, so that a change of sensitivity changes no offset
        cols.append((x - settings.get("centre", (0.0,))[0]) * d)
    return np.stack(cols, axis=1)


def _guess(signal: str, x: Array, residual: Array, ctx: Context, settings: Settings) -> Sequence[Sequence[float]]:
    dt, span = settings["time"]
    k = thin(ctx.keep, 8000)
    straight = np.stack([np.ones(k.size), x[k]], axis=1)
    if not settings["gain"][0]:
        straight = straight[:, :1]
    tried: list[tuple[float, float]] = []
    for tau in (0.02 * dt, *np.geomspace(2 * dt, 0.2 * span, 12)):
        cols = _basis(signal, x, ctx, np.array([tau]), settings)[k]
        tried.append((least_squares(np.column_stack([straight, cols]), residual[k])[1], float(tau)))
    # without a lag unless a lag is clearly better
    plain = tried[0]
    tried.sort()
    best = [plain] if tried[0][0] > 0.98 * plain[0] else [tried[0], plain]
    return tuple((tau,) for _, tau in best)


def _temp_report(p: Array, settings: Settings, scale: float) -> Sequence[Human]:
    out = [
        Human("bias_per_K", float(p[1]), "{out}/K"),
        Human("bias_per_K2", float(p[2]), "{out}/K^2"),
        Human("thermal_lag_s", float(p[0]), "s"),
    ]
    if p.size > 3:
        out.append(Human("scale_per_K", float(p[3] / scale) if scale else 0.0, "1/K"))
    return out


TEMPERATURE_SENSITIVITY = Effect(
    name="temperature_sensitivity",
    summary="follows a recorded temperature",
    kind="add",
    stages=("sensor", "environment"),
    parts=partial(_parts, "K", "thermal_lag_s"),
    equation=r"y = x + a\,\Delta T + b\,\Delta T^2 + c\,(x - x_0)\,\Delta T,\; \Delta T \text{ behind a thermal lag}",
    source="IEEE Std 1293-2018, temperature model; J. Fraden, Handbook of Modern Sensors, 5th ed., section 3.2",
    excitation="a temperature that changes by more than sensor noise can hide, best up and down again",
    confusable_with=("thermal_drift", "random_walk", "supply_sensitivity"),
    prepare=partial(_prepare, "temperature"),
    guess=partial(_guess, "temperature"),
    basis=partial(_basis, "temperature"),
    report=_temp_report,
    sites=("output",),
    needs=("temperature",),
    available=partial(_varies, "temperature"),
    vanishes_with=(("bias_per_K", "bias_per_K2", "scale_per_K"),),
)

# -- supply -----------------------------------------------------------------------------------------


def _supply_report(p: Array, settings: Settings, scale: float) -> Sequence[Human]:
    reference = settings["reference"][0]
    out = [
        Human("bias_per_V", float(p[1]), "{out}/V"),
        Human("bias_per_V2", float(p[2]), "{out}/V^2"),
        Human("supply_lag_s", float(p[0]), "s"),
    ]
    if p.size > 3:
        relative = float(p[3] / scale * reference) if scale else 0.0
        out.append(Human("ratiometric_share", relative, "1"))
    return out


SUPPLY_SENSITIVITY = Effect(
    name="supply_sensitivity",
    summary="follows a recorded supply voltage (ratiometric)",
    kind="add",
    stages=("sensor", "acquisition"),
    parts=partial(_parts, "V", "supply_lag_s"),
    equation=r"y = x + a\,\Delta V_s + b\,\Delta V_s^2 + c\,(x - x_0)\,\Delta V_s,\; \Delta V_s \text{ behind an RC}",
    source="ADXL103/ADXL203 data sheet, section Using the ADXL103/ADXL203 with operating voltages other than 5 V",
    excitation="a supply that changes, and an input that changes with it and without",
    confusable_with=("temperature_sensitivity", "random_walk"),
    prepare=partial(_prepare, "supply"),
    guess=partial(_guess, "supply"),
    basis=partial(_basis, "supply"),
    report=_supply_report,
    sites=("output",),
    needs=("supply",),
    available=partial(_varies, "supply"),
    vanishes_with=(("bias_per_V", "bias_per_V2", "scale_per_V", "ratiometric_share"),),
)

# -- current ----------------------------------------------------------------------------------------


def _current_name(signals: Mapping[str, Array]) -> str:
    return next((s for s in ("actuator_current", "current") if s in signals), "")


def _current_available(signals: Mapping[str, Array], output: str) -> str:
    name = _current_name(signals)
    return _varies(name, signals, output) if name else "no actuator current recorded"


def _current_basis(x: Array, ctx: Context, q: Array, settings: Settings) -> Array:
    name = _current_name(ctx.signals)
    i = ctx.signals[name] if name else np.zeros(ctx.t.size)
    return np.stack([i, i * i], axis=1)


def _current_report(p: Array, settings: Settings, scale: float) -> Sequence[Human]:
    out = [Human("per_A", float(p[0]), "{out}/A"), Human("per_A2", float(p[1]), "{out}/A^2")]
    if scale:
        out.append(Human("input_equivalent_per_A", float(p[0] / scale), "{in}/A"))
    return out


CURRENT_COUPLING = Effect(
    name="current_coupling",
    summary="field or voltage that follows a recorded actuator current",
    kind="add",
    stages=("environment", "acquisition"),
    parts=lambda settings: Parts(
        (), (Parameter("per_A", "{out}/A"), Parameter("per_A2", "{out}/A^2")), np.diag([0.02, 0.1])
    ),
    equation=r"y = x + a I + b I^2",
    source="J. D. Jackson, Classical Electrodynamics, 3rd ed., eq. 5.4 (Biot-Savart: field proportional to current)",
    excitation="a current that changes apart from the field",
    confusable_with=("supply_sensitivity", "mains_interference"),
    basis=_current_basis,
    report=_current_report,
    driven=False,
    sites=("output",),
    available=_current_available,
    vanishes_with=(("per_A", "per_A2"),),
)
