"""The emulated lab of chapter 7 of Ang 2004: stacks under an interferometer, paths to track, four ways to command.

Identification uses the lab's calibration set, tracking its own runs: no path that is tracked has been fitted.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path

import numpy as np
from scipy.signal import lfilter

from firmware_py.actuation.config import StackConfig
from hal.arrays import Array
from sim_devices.config import EmulationConfig
from sim_devices.plant.kernel import STEP_S, STEPS_PER_MS
from sim_devices.plant.lab import (
    CALIBRATION_SET,
    INTERFEROMETER_RMS_UM,
    drive_stack,
    measure_piezo,
    sample_rate_hz,
)
from sim_devices.plant.stack import drive_channel, stack_unit
from tools.calibrate.piezo import identify_stack, rates_of
from tools.calibrate.piezo_dynamics import delayed
from tools.calibrate.piezo_excitation import determined_from
from tools.calibrate.piezo_feedforward import for_instrument
from tools.calibrate.piezo_fit import PiezoFit
from tools.calibrate.piezo_prediction import command
from tools.calibrate.piezo_regression import Piece, Shape, axes_of, fit, residual, stack_of
from tools.mismatch.recording import Recording, Split, TwinText
from tools.numbers import rms

UNIT = 2  # of the emulated instrument
DT_S = 1e-3
NEUTRAL_V = 50.0
SWING_V = 41.7  # half of peak to peak, about 12.5 um
TEMPERATURE_C = 25.0
APPROACH = 2000  # ticks from rest to the start of a path, not scored
SCORED = 5000  # 5 s, as in Ang 2004
LOW_UM = -5.0  # lowest point of a path of 12.5 um p-p, from rest at neutral: the middle of the range

# Ang 2004, sec. 7.4: thresholds in V and dead zones of the published models (fractions of 41.7 V, of the displacement)
INDEPENDENT = Shape(tuple(v / SWING_V for v in range(0, 41, 5)), zones=(0.633, 0.748, 0.873))
DEPENDENT = Shape(
    tuple(v / SWING_V for v in (0, 4, 8, 12, 16, 20, 25, 31, 38)),
    zones=(0.633, 0.748, 0.873),
    rate=True,
    rate_high_um_per_s=200.0,
)


@dataclass(frozen=True)
class Controller:
    """A way to command one stack. ``stack`` None: a straight line, V from um, ``line`` = (V per um, V at zero).
    ``preview_s``: how far ahead of the path it is driven; ``taps``: on the path, newest first."""

    stack: StackConfig | None
    preview_s: float = 0.0
    line: tuple[float, float] = (0.0, 0.0)
    taps: tuple[float, ...] = (1.0,)


@dataclass(frozen=True)
class Stand:
    """Holds the controllers of a stack in the lab.

    ``late``: without a model, rate-independent and rate-dependent as in Ang 2004, without preview; ``early``: the same
    three identified and driven with the lag of ``fit``; ``ours``: model, preview and taps; ``ours_late``: our model
    and no preview."""

    fit: PiezoFit
    late: tuple[Controller, ...]
    early: tuple[Controller, ...]
    ours: Controller
    ours_late: Controller


@dataclass(frozen=True)
class Tracking:
    """Error of one run, um, counted from rest before the approach; the same less its mean; how many of its commands
    were limited."""

    rms_um: float
    max_um: float
    free_rms_um: float
    free_max_um: float
    limited: int


def recording(
    config: EmulationConfig, axis: int, profile: str, rate_hz: float, seconds: float, share: float = 1.0
) -> Recording:
    """Return a recording of the lab, as ``micron calibrate piezo`` would load it."""
    columns, _ = measure_piezo(config, axis, profile, rate_hz, seconds, share * SWING_V)
    n, dt = len(columns["command_V"]), 1.0 / sample_rate_hz(profile)
    return Recording(
        path=Path(f"{profile}-{rate_hz:g}Hz"),
        title=profile,
        t=np.asarray(np.arange(n) * dt, dtype=np.float64),
        dt=dt,
        inputs={"command": columns["command_V"]},
        outputs={"displacement": columns["displacement_um"]},
        context={},
        noise={"displacement": INTERFEROMETER_RMS_UM},
        unit={"command": "V", "displacement": "um"},
        column={"command": "command_V", "displacement": "displacement_um"},
        twin=TwinText("piezo_stack", {"hold": "zero"}),
        split=Split(),
    )


def published_model(recordings: Sequence[Recording], shape: Shape, lag_s: float) -> StackConfig:
    """A model of the published form: given thresholds, and the lag that is taken for all."""
    drives = [r.inputs["command"] for r in recordings]
    pieces = [
        Piece(
            delayed(u, lag_s, DT_S), r.outputs["displacement"], np.zeros(len(u)),
            slice(determined_from(u), len(u)), DT_S, np.ones(1),
        )
        for u, r in zip(drives, recordings, strict=True)
    ]  # fmt: skip
    pieces = rates_of(pieces, replace(shape, rate=False), NEUTRAL_V)
    axes = axes_of(pieces, shape, NEUTRAL_V)
    solution, _ = fit(pieces, shape, axes, [])
    zero = float(np.mean([residual(p, shape, axes, solution).mean() for p in pieces]))
    return stack_of(solution, shape, axes, zero)


def rising_line(sine: Recording, lag_s: float) -> tuple[float, float]:
    """V per um and V at rest of a straight line through the rising branch: control without a model."""
    u, z = delayed(sine.inputs["command"], lag_s, DT_S), sine.outputs["displacement"]
    last = slice(len(u) // 2, None)
    up = (np.gradient(u) > 0.0)[last]
    slope, zero = np.polyfit(z[last][up], u[last][up], 1)
    return float(slope), float(zero)


def stand(config: EmulationConfig, axis: int) -> Stand:
    """Every way to command the stack ``axis``, each from recordings of this stack."""
    sine = recording(config, axis, "sine", 10.0, 4.0)
    everything = [recording(config, axis, *one) for one in CALIBRATION_SET]
    saw_teeth = [r for r in everything if r.path.name.startswith("sawtooth")]
    rest_um = float(np.mean(run(config, axis, np.full(200, NEUTRAL_V))))
    fit = identify_stack(everything)

    def three(lag_s: float) -> tuple[Controller, ...]:
        slope, zero = rising_line(sine, lag_s)
        return (
            Controller(None, lag_s, (slope, zero + slope * rest_um)),
            Controller(published_model([sine], INDEPENDENT, lag_s), lag_s),
            Controller(published_model(saw_teeth, DEPENDENT, lag_s), lag_s),
        )

    inverse = for_instrument([fit.answer])
    return Stand(
        fit,
        three(0.0),
        three(fit.lag_s),
        Controller(fit.stack, inverse.preview_s, taps=inverse.taps[0]),
        Controller(fit.stack),
    )


@cache
def lab() -> tuple[EmulationConfig, tuple[Stand, ...]]:
    """The unit and its three stacks with every way to command them."""
    config = EmulationConfig(unit=UNIT, seed=UNIT)
    return config, tuple(stand(config, axis) for axis in range(3))


def run(config: EmulationConfig, axis: int, volts: Array) -> Array:
    """Strokes um of a stack that was at rest at neutral, without noise."""
    unit = stack_unit(config.stack, config.unit, axis)
    params, state = drive_channel(unit, config.amplifier, STEP_S, TEMPERATURE_C)
    stroke, terminal = np.empty(len(volts)), np.empty(len(volts))
    drive_stack(params, state, volts, TEMPERATURE_C, STEPS_PER_MS, (stroke, terminal))
    return stroke * 1e6


def with_approach(path_um: Array, first_um: float) -> Array:
    """The path with a smooth way to its first point and a pause there; rows from ``APPROACH`` on are the path."""
    s = np.clip(np.arange(APPROACH) / (0.75 * APPROACH), 0.0, 1.0)
    return np.concatenate([first_um * s**3 * (10.0 - 15.0 * s + 6.0 * s * s), path_um])


def track(config: EmulationConfig, axis: int, controller: Controller, path_um: Array, seed: int) -> Tracking:
    """Drive the stack along ``path_um`` (n,), um from rest, and read the interferometer (0.07 um rms)."""
    wanted = with_approach(path_um, float(path_um[0]))
    t = np.arange(len(wanted)) * DT_S
    # linear between the path's samples, held at its end
    ahead = np.interp(t + controller.preview_s, t, wanted)
    ahead = ahead[0] + np.asarray(lfilter(controller.taps, [1.0], ahead - ahead[0]), dtype=np.float64)
    limited = 0
    if controller.stack is None:
        slope, zero = controller.line
        volts = np.clip(zero + slope * ahead, 0.0, 100.0)
    else:
        asked = command(controller.stack, ahead, neutral_V=NEUTRAL_V)
        volts, limited = asked.drive_V, asked.singular + asked.voltage + asked.slew
    z = run(config, axis, volts)
    noise = INTERFEROMETER_RMS_UM * np.random.default_rng(seed).standard_normal(len(z))
    e = (z - z[0] + noise - wanted)[APPROACH:]
    free = e - e.mean()
    return Tracking(rms(e), float(np.max(np.abs(e))), rms(free), float(np.max(np.abs(free))), limited)


def stationary(frequency_hz: float) -> Array:
    """12.5 um p-p, from its lowest point."""
    t = np.arange(SCORED) * DT_S
    return LOW_UM + 6.25 * (1.0 - np.cos(2.0 * np.pi * frequency_hz * t))


def multi_frequency(seed: int) -> Array:
    """1, 10 and 19 Hz with amplitudes that vary in time, 12.5 um p-p together."""
    rng = np.random.default_rng(seed)
    t = np.arange(SCORED) * DT_S
    x = np.zeros(SCORED)
    for hz, share in ((1.0, 0.5), (10.0, 0.3), (19.0, 0.2)):
        slow, phase, turn = rng.uniform(0.1, 0.5), *rng.uniform(0.0, 2.0 * np.pi, 2)
        x += share * (1.0 + 0.7 * np.sin(2.0 * np.pi * slow * t + phase)) * np.sin(2.0 * np.pi * hz * t + turn)
    return LOW_UM + 12.5 * (x - x.min()) / np.ptp(x)
