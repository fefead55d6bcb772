"""Simulates a piezo stack and its amplifier channel.

Stack: generalised Maxwell slip in the voltage domain. The effective drive is y = u - sum w_k s_k, where each s_k is a
spring in series with a slider: s_k' = u' while |s_k| is below its threshold, and above it the excess relaxes with a
time constant (viscous slip), so the loop opens with the rate. The thresholds fall with the bias (minor loops at
different bias are not congruent, which no Prandtl-Ishlinskii model can do). Then static curvature, a Kelvin-Voigt
chain for creep (one element per decade of time), thermal expansion and one damped resonance of stack, lever and shaft.
Sources: Goldfarb and Celanovic 1997 (Maxwell slip), Al-Bender, Lampaert, Swevers 2005 (generalised), Ang 2004 ch. 7
(size).

Amplifier: limits, slew limit, first-order bandwidth, output resistance into the stack's capacitance.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import expm

from hal.arrays import Array
from hal.compiled import kernel
from sim_devices.config import AmplifierConfig, StackConfig
from sim_devices.plant.streams import stream

SLIPS = 12
REFERENCE_C = 25.0
"""Temperature at which the amplifier has its nominal gain."""
CREEPS = 5
CREEP_TIMES_S = (0.05, 0.5, 5.0, 50.0, 500.0)

DRIVE = np.dtype(
    [
        ("step_s", "f8"),
        ("low_V", "f8"),
        ("high_V", "f8"),
        ("slew_step_V", "f8"),
        ("lag", "f8"),  # 1 - exp(-step / tau)
        ("output_lag", "f8"),
        ("farad", "f8"),
        ("gain_per_K", "f8"),
        ("threshold_V", "f8", (SLIPS,)),
        ("weight", "f8", (SLIPS,)),
        ("slip_keep", "f8", (SLIPS,)),
        ("slip_gain", "f8", (SLIPS,)),
        ("slip_bias", "f8"),
        ("low_y", "f8"),
        ("swing_y", "f8"),
        ("stroke_m", "f8"),
        ("curvature", "f8"),
        ("creep_share", "f8"),
        ("creep_lag", "f8", (CREEPS,)),
        ("mode", "f8", (2, 2)),
        ("mode_from", "f8", (2,)),
        ("mode_to", "f8", (2,)),
        ("expansion_m_per_K", "f8"),
        ("reference_C", "f8"),
        ("reference_m", "f8"),
    ]
)
"""Parameters of one channel, made discrete for ``step_s``."""

DRIVE_STATE = np.dtype(
    [
        ("amplifier_V", "f8"),
        ("stack_V", "f8"),
        ("current_A", "f8"),
        ("slip_V", "f8", (SLIPS,)),
        ("creep_m", "f8", (CREEPS,)),
        ("drive_m", "f8"),
        ("mode", "f8", (2,)),  # stroke m, its rate m/s
    ]
)


@dataclass(frozen=True)
class StackUnit:
    """Holds the parameters of one physical stack, which the seed draws. Arrays (SLIPS,) run over the slip elements."""

    stroke_m: float
    threshold_V: Array
    weight: Array
    slip_time_s: Array
    slip_bias: float
    curvature: float
    creep_per_decade: float
    resonance_hz: float
    damping: float
    expansion_m_per_K: float


def stack_unit(config: StackConfig, seed: int, axis: int) -> StackUnit:
    """Return the stack of ``axis`` (0, 1, 2)."""
    rng = stream(seed, f"stack.{axis}")
    draw = rng.standard_normal(4)
    width_V = config.slip_limit_V / SLIPS
    threshold_V = (np.arange(SLIPS) + 0.5 + 0.2 * rng.uniform(-1.0, 1.0, SLIPS)) * width_V
    # part of the elements evenly over the thresholds (Rayleigh's law for small loops), part around the coercive drive
    place = (np.arange(SLIPS) + 0.5) / SLIPS
    weight = 0.4 + 0.6 * 2.0 * np.minimum(place / 0.45, (1.0 - place) / 0.55)
    weight *= (1.0 + 0.1 * rng.standard_normal(SLIPS)) / SLIPS
    weight *= config.slip_sum * (1.0 + config.slip_spread * draw[0]) / weight.sum()
    return StackUnit(
        stroke_m=config.stroke_um_at_100_V * 1e-6 * (1.0 + config.stroke_spread * draw[1]),
        threshold_V=threshold_V,
        weight=weight,
        slip_time_s=config.slip_viscous_ms * 1e-3 * np.exp(0.7 * rng.standard_normal(SLIPS)),
        slip_bias=config.slip_bias,
        curvature=config.curvature * (1.0 + 0.2 * draw[2]),
        creep_per_decade=config.creep_per_decade,
        resonance_hz=config.resonance_hz * (1.0 + config.resonance_spread * draw[3]),
        damping=config.damping,
        expansion_m_per_K=config.expansion_um_per_K * 1e-6,
    )


@kernel
def effective_drive(p, s, change_V, stack_V):
    """Return the effective drive y in V and move the slip elements by ``change_V`` to the voltage ``stack_V`` within
    one step."""
    y = stack_V
    scale = 1.0 - p["slip_bias"] * (stack_V - 50.0) / 50.0
    slip, threshold, weight = s["slip_V"], p["threshold_V"], p["weight"]
    keep, gain = p["slip_keep"], p["slip_gain"]
    for k in range(SLIPS):
        limit = threshold[k] * scale
        old = slip[k]
        new = old + change_V
        sign = 1.0 if new >= 0.0 else -1.0
        if sign * new > limit:
            before = max(sign * old - limit, 0.0)
            beyond = sign * new - limit - before
            new = sign * (limit + max(before * keep[k] + beyond * gain[k], 0.0))
        slip[k] = new
        y -= weight[k] * new
    return y


@kernel
def drive_step(p, s, demand_V, temperature_C):
    """Make one step of amplifier and stack at a demand (V) held over the step. The stroke is ``s["mode"][0]``, in m."""
    gain = 1.0 + p["gain_per_K"] * (temperature_C - REFERENCE_C)
    target = min(max(gain * demand_V, p["low_V"]), p["high_V"])
    move = (target - s["amplifier_V"]) * p["lag"]
    slew = p["slew_step_V"]
    s["amplifier_V"] += min(max(move, -slew), slew)
    change = (s["amplifier_V"] - s["stack_V"]) * p["output_lag"]
    s["stack_V"] += change
    s["current_A"] = p["farad"] * change / p["step_s"]
    y = (effective_drive(p, s, change, s["stack_V"]) - p["low_y"]) / p["swing_y"]
    x = p["stroke_m"] * (y + p["curvature"] * (y * y - y))
    creep = s["creep_m"]
    target_m = p["creep_share"] * (x - p["reference_m"])
    x += p["expansion_m_per_K"] * (temperature_C - p["reference_C"])
    for j in range(CREEPS):
        creep[j] += (target_m - creep[j]) * p["creep_lag"][j]
        x += creep[j]
    mode = s["mode"]
    m0, m1 = mode[0], mode[1]
    for d in range(2):
        mode[d] = p["mode"][d, 0] * m0 + p["mode"][d, 1] * m1 + p["mode_from"][d] * s["drive_m"] + p["mode_to"][d] * x
    s["drive_m"] = x


@kernel
def sweep(p, s, volts):
    """Quasi-static drive along ``volts`` (n,); last effective drive, V. For conditioning, not for time."""
    y = 0.0
    v = s["stack_V"]
    for n in range(volts.shape[0]):
        y = effective_drive(p, s, volts[n] - v, volts[n])
        v = volts[n]
    s["stack_V"] = v
    return y


def second_order(resonance_hz: float, damping: float, step_s: float) -> tuple[Array, Array, Array]:
    """x'' + 2 d w x' + w^2 x = w^2 u with u linear over a step: (2, 2) transition, weights of u before and after."""
    w = 2.0 * math.pi * resonance_hz
    system = np.zeros((4, 4))  # x, x', u, u'
    system[0, 1] = system[2, 3] = 1.0
    system[1, :3] = [-w * w, -2.0 * damping * w, w * w]
    e: Array = np.asarray(expm(system * step_s), dtype=np.float64)
    to = e[:2, 3] / step_s
    return e[:2, :2].copy(), e[:2, 2] - to, to


def drive_channel(
    unit: StackUnit, amplifier: AmplifierConfig, step_s: float, temperature_C: float
) -> tuple[NDArray[np.void], NDArray[np.void]]:
    """Parameters (DRIVE, one row) and state (DRIVE_STATE) of a channel at rest at its neutral voltage.

    The stack has been driven over its whole range, then up from 0 V to neutral, and has crept to its end there.
    """
    gain = 1.0 + amplifier.gain_per_K * (temperature_C - REFERENCE_C)
    rest_V = min(max(gain * amplifier.neutral_V, amplifier.low_V), amplifier.high_V)
    params, state = np.zeros(1, DRIVE), np.zeros(1, DRIVE_STATE)
    p, s = params[0], state[0]
    p["step_s"] = step_s
    p["low_V"], p["high_V"] = amplifier.low_V, amplifier.high_V
    p["slew_step_V"] = amplifier.slew_V_per_ms * 1e3 * step_s
    p["lag"] = -math.expm1(-2.0 * math.pi * amplifier.bandwidth_hz * step_s)
    p["output_lag"] = -math.expm1(-step_s / (amplifier.output_ohm * amplifier.stack_farad))
    p["farad"], p["gain_per_K"] = amplifier.stack_farad, amplifier.gain_per_K
    p["threshold_V"], p["weight"], p["slip_bias"] = unit.threshold_V, unit.weight, unit.slip_bias
    p["curvature"], p["creep_share"] = unit.curvature, unit.creep_per_decade
    p["creep_lag"] = -np.expm1(-step_s / np.array(CREEP_TIMES_S))
    p["mode"], p["mode_from"], p["mode_to"] = second_order(unit.resonance_hz, unit.damping, step_s)
    p["expansion_m_per_K"], p["reference_C"] = unit.expansion_m_per_K, temperature_C

    up, down = np.linspace(0.0, 100.0, 401), np.linspace(100.0, 0.0, 401)
    sweep(p, s, up)
    low_y = sweep(p, s, down)
    high_y = sweep(p, s, up)
    p["low_y"], p["swing_y"], p["stroke_m"] = low_y, high_y - low_y, unit.stroke_m
    sweep(p, s, down)
    y = (sweep(p, s, np.linspace(0.0, rest_V, 401)) - low_y) / (high_y - low_y)
    rest_m = unit.stroke_m * (y + unit.curvature * (y * y - y))
    s["amplifier_V"] = s["stack_V"] = rest_V
    s["mode"][0] = s["drive_m"] = p["reference_m"] = rest_m
    p["slip_keep"] = np.exp(-step_s / unit.slip_time_s)
    p["slip_gain"] = (1.0 - p["slip_keep"]) * unit.slip_time_s / step_s
    return params, state
