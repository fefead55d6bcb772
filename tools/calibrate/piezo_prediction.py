"""Predicts with a fitted model: displacement of a drive, drive of a wanted displacement, error of a tremor profile.

Both directions are the firmware's own kernels, one tick after the other.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from firmware_py.actuation.config import StackConfig
from firmware_py.actuation.hysteresis import drive, operator_params, plays_at, slopes_at, stack_stroke
from firmware_py.actuation.limits import limit_slew, limit_voltage
from firmware_py.records import Record, attributes
from hal.arrays import Array
from hal.compiled import kernel
from tools.calibrate.piezo_fit import PiezoFit

UM = 1e-6


@dataclass(frozen=True)
class Commanded:
    """Drive V of a wanted path, and how often slope, voltage and slew had to be limited."""

    drive_V: Array
    singular: int
    voltage: int
    slew: int


@kernel
def forward_kernel(volts: Array, rate: Array, plays: Array, creep: Array, stack: Record, out: Array) -> None:
    slopes = np.empty(len(plays))
    for k in range(len(volts)):
        slopes_at(rate[k], stack, slopes)
        out[k] = stack_stroke(volts[k], slopes, plays, creep, stack)


@kernel
def inverse_kernel(
    wanted: Array, tick_hz: float, limits: Array, memory: tuple[Array, Array], stack: Record, out: Array
) -> tuple[int, int, int]:
    """Invert the model for a wanted displacement (n,) in um. ``limits`` are low V, high V, slew V per tick, V at the
    start; ``memory`` are the plays and the creep."""
    plays, creep = memory
    slopes = np.empty(len(plays))
    singular, voltage, slew = 0, 0, 0
    before_V = limits[3]
    before = wanted[0]
    for k in range(len(wanted)):
        singular += slopes_at(abs(wanted[k] - before) * tick_hz, stack, slopes)
        u = drive(wanted[k], slopes, plays, creep, stack)
        inside_V = limit_voltage(u, limits[0], limits[1])
        voltage += inside_V != u
        out[k] = limit_slew(inside_V, before_V, limits[2])
        slew += out[k] != inside_V
        stack_stroke(out[k], slopes, plays, creep, stack)
        before_V, before = out[k], wanted[k]
    return singular, voltage, slew


def rest_stroke(stack: StackConfig, drive_V: float, tick_hz: float, high_V: float) -> tuple[Record, Array, float]:
    """Return the stack's numbers with creep counted from rest at ``drive_V``, its play states (n,) and its stroke in m
    there."""
    params: Record = operator_params(stack, tick_hz)
    at = attributes(params)[0]
    plays, slopes, none = plays_at(at, drive_V, high_V), np.empty(len(at.r)), np.zeros(len(at.creep_share))
    slopes_at(0.0, params[0], slopes)
    still = params.copy()
    still["creep_share"] = 0.0
    rest = stack_stroke(drive_V, slopes, plays.copy(), none, still[0])
    params["creep_reference"] = rest
    return params, plays, rest


def simulate(stack: StackConfig, drive_V: Array, tick_hz: float = 1000.0, high_V: float = 100.0) -> Array:
    """Displacement um (n,) for a drive V (n,), from rest at ``drive_V[0]`` after cycles over the whole range.

    The rate is that of the displacement itself, found without the rate first.
    """
    rate = np.zeros(len(drive_V))
    out = np.empty(len(drive_V))
    for _ in range(2 if stack.slope_per_rate_s_per_V else 1):
        params, plays, _ = rest_stroke(stack, float(drive_V[0]), tick_hz, high_V)
        creep = np.zeros(len(params["creep_share"][0]))
        forward_kernel(drive_V, rate, plays, creep, params[0], out)
        rate = np.abs(np.diff(out, prepend=out[0])) * tick_hz
    return out / UM


def command(
    stack: StackConfig,
    wanted_um: Array,
    *,
    neutral_V: float = 50.0,
    tick_hz: float = 1000.0,
    low_V: float = 0.0,
    high_V: float = 100.0,
    slew_V_per_s: float = 20_000.0,
) -> Commanded:
    """Drive for displacements ``wanted_um`` (n,) from rest at ``neutral_V``, limited as the firmware limits it."""
    params, plays, rest = rest_stroke(stack, neutral_V, tick_hz, high_V)
    creep = np.zeros(len(params["creep_share"][0]))
    out = np.empty(len(wanted_um))
    limits = np.array([low_V, high_V, slew_V_per_s / tick_hz, neutral_V])
    counts = inverse_kernel(rest + wanted_um * UM, tick_hz, limits, (plays, creep), params[0], out)
    return Commanded(out, *map(int, counts))


@dataclass(frozen=True)
class Prediction:
    """Holds the expected tracking of a tremor profile of ``wanted_um`` peak to peak: rms and largest error, in um."""

    wanted_um: float
    rms_um: float
    max_um: float
    limited_ticks: int


def tremor_profile_um(peak_to_peak_um: float, tick_hz: float = 1000.0, seconds: float = 5.0) -> Array:
    """Return a tremor (n,) in um as Ang 2004 describes it: tones of 8 to 12 Hz with wandering amplitudes, from
    neutral."""
    t = np.arange(round(seconds * tick_hz)) / tick_hz
    x = np.zeros(len(t))
    for hz, slow_hz, phase in ((8.3, 0.31, 0.0), (9.7, 0.23, 2.0), (11.4, 0.17, 4.0)):
        x += (1.0 + 0.6 * np.sin(2.0 * np.pi * slow_hz * t + phase)) * np.sin(2.0 * np.pi * hz * t)
    x *= np.minimum(1.0, t / 0.3)
    return peak_to_peak_um * x / np.ptp(x)


def predict(fit: PiezoFit, share: float = 0.8) -> Prediction:
    """Expected tracking of a tremor over ``share`` of the identified range.

    What no model explained in recordings that it had not seen is what remains of the error, the instrument's noise
    included; ``others``, the models that lack one recording each, say how far the parameters are uncertain.
    """
    stack = fit.stack
    wanted = tremor_profile_um(share * fit.range_um, fit.tick_hz)
    # centred in the range, not at neutral
    rest = simulate(stack, np.array([fit.neutral_V]), fit.tick_hz, fit.high_V)[0]
    low, high = fit.span_um
    wanted = wanted + np.minimum(1.0, np.arange(len(wanted)) / (0.3 * fit.tick_hz)) * (0.5 * (low + high) - rest)
    asked = command(stack, wanted, neutral_V=fit.neutral_V, tick_hz=fit.tick_hz, low_V=fit.low_V, high_V=fit.high_V)
    z0 = simulate(stack, np.concatenate([[fit.neutral_V], asked.drive_V]), fit.tick_hz, fit.high_V)
    scatter = np.zeros(len(wanted))
    for other in fit.others:
        z = simulate(other, np.concatenate([[fit.neutral_V], asked.drive_V]), fit.tick_hz, fit.high_V)
        scatter += ((z[1:] - z[0]) - (z0[1:] - z0[0])) ** 2 / len(fit.others)
    scored = slice(round(0.5 * fit.tick_hz), None)
    rms = float(np.sqrt(np.mean(scatter[scored]) + fit.held_out_rms_um**2))
    return Prediction(
        float(np.ptp(wanted[scored])),
        rms,
        float(np.sqrt(np.max(scatter[scored])) + 3.0 * fit.held_out_rms_um),
        asked.singular + asked.voltage + asked.slew,
    )
