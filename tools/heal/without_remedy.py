"""Finds changes for which the firmware has no remedy: an amplifier that its monitor stops, a gain that follows
temperature, a play in the mount.

The gain is measured in a climate chamber at ``WARMER_K`` about the room's temperature, the play in slow loops of the
tip. The engine is not asked about those: the modelled tip has the noise of the interferometers, and what smooths an
input that is noisy (a lag, a resonance) explains its residual better.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from scipy.signal import butter, filtfilt
from scipy.stats import f as f_test
from scipy.stats import linregress

from drivers.options import AmplifierMonitorOptions
from drivers.specs import check_devices
from sim_devices.config import EmulationConfig
from sim_devices.plant.lab import drive_profile, in_place, measure_rest_V, measure_volts
from sim_devices.plant.lab_tip import TIP_HZ, measure_tip
from tools.calibrate.manipulator import NAMES, identify_manipulator, load_scan, tip_um
from tools.heal.parts import AMPLITUDE_V, Lab, scan_tip
from tools.mismatch.recording import Array

WARMER_K = (-6.0, -3.0, 0.0, 3.0, 6.0)
LOOPS_S, LOOPS_HZ = 8.0, 1000.0
LEVEL = 1e-3
"""Level of each test, over all stacks, axes and sizes."""
TIP_S = 40.0
PLAYS_UM = np.geomspace(0.5, 100.0, 60)
LEAST_SHARE = 0.7
"""Smallest share of a play's missing travel that must be missing, and the inverse of the largest."""
SMOOTH_HZ = 3.0


def name_stacks(lab: Lab) -> tuple[str, ...]:
    """Name what calibrations of stacks cannot put right."""
    return (*name_output(lab), *name_temperature(lab))


def name_output(lab: Lab) -> tuple[str, ...]:
    """Name each output whose voltage differs by more than the amplifier's monitor lets pass."""
    options = check_devices(lab.bench.description, str(lab.bench.path)).values()
    allowed_V = min((o.tolerance_V for o in options if isinstance(o, AmplifierMonitorOptions)), default=np.inf)
    told_V = lab.config.amplifier.neutral_V
    at_V = [measure_rest_V(lab.config, axis) for axis in range(3)]
    return tuple(
        f"output {axis + 1} at {volts:.2f} V where {told_V:.2f} V is told, which the monitor answers with a stop"
        for axis, volts in enumerate(at_V)
        if abs(volts - told_V) > allowed_V
    )


def name_temperature(lab: Lab) -> tuple[str, ...]:
    """Name the stacks whose gain follows temperature, and by how much."""
    volts = drive_profile("loops", 10.0, LOOPS_S, AMPLITUDE_V, lab.config.seed)
    named: list[str] = []
    for axis in range(3):
        twin = in_place(lab.config, lab.bench.path, axis, None)
        gains: list[float] = []
        for k, kelvin in enumerate(WARMER_K):
            warm, noise = _warmer(lab.config, kelvin), f"chamber.{k}"
            columns, _ = measure_volts(warm, axis, volts, LOOPS_HZ, noise=noise, what="", twin=twin)
            gains.append(float(np.polyfit(volts, columns["displacement_um"], 1)[0]))
        line: Any = linregress(WARMER_K, gains)
        if line.pvalue < LEVEL / 3:
            share = line.slope / float(np.mean(gains))
            named.append(f"stack {axis + 1} {share:+.2%} per kelvin")
    return (f"gain that follows temperature ({', '.join(named)})",) if named else ()


def _warmer(config: EmulationConfig, kelvin: float) -> EmulationConfig:
    room = config.environment
    return config.model_copy(update={"environment": room.model_copy(update={"ambient_C": room.ambient_C + kelvin})})


def name_play(lab: Lab) -> tuple[str, ...]:
    """Name the play between manipulator and tip, along x and y of the body."""
    named = [f"{axis} {play:.1f} um" for axis, play in zip("xy", find_play(lab), strict=True) if play > 0.0]
    return (f"play between manipulator and tip ({', '.join(named)})",) if named else ()


def find_play(lab: Lab) -> tuple[float, float]:
    """Return the play (um) along x and y that the tip's motion shows, 0 where it shows none.

    The tip's record less the geometry that fits the lab's scan best is compared with the travel that each play of
    ``PLAYS_UM`` would take away. A play is found by an F-test if that travel is missing as a whole, not in part.
    """
    fit = identify_manipulator(load_scan(scan_tip(lab)))
    columns = measure_tip(lab.config, TIP_S)
    modelled = tip_um(np.array([fit.parameters[n].value for n in NAMES]), columns["stroke_um"])
    away = columns["tip_um"] - modelled
    # the noise of the strokes must not turn the play back
    low_pass: Any = butter(2, SMOOTH_HZ, fs=TIP_HZ)
    smooth = filtfilt(low_pass[0], low_pass[1], modelled, axis=0)
    level = LEVEL / (2 * len(PLAYS_UM))
    x, y = (_play(smooth[:, i], away[:, i] - away[:, i].mean(), level) for i in range(2))
    return x, y


def _play(course: Array, away: Array, level: float) -> float:
    least, best_um = float(away @ away), 0.0
    for play in PLAYS_UM:
        missing = _behind_play(course, play) - course
        missing -= missing.mean()
        power = max(float(missing @ missing), 1e-30)
        share = float(missing @ away) / power
        rest = float(away @ away) - share * share * power
        if rest < least and LEAST_SHARE < share < 1.0 / LEAST_SHARE:
            least, best_um = rest, float(play)
    free = away.size - 2
    is_found = float(f_test.sf((float(away @ away) - least) / least * free, 1, free)) < level
    return best_um if is_found else 0.0


def _behind_play(course: Array, play: float) -> Array:
    """Return a course (n,) behind a play, with the memory of the lab's first instant: rest at zero."""
    out, seat = np.empty_like(course), 0.0
    for k, x in enumerate(course):
        seat = out[k] = min(max(seat, x - 0.5 * play), x + 0.5 * play)
    return out


WITHOUT_REMEDY = {"stacks": name_stacks, "manipulator": name_play}
"""Experiments by the part beside which they are made. Each returns the names of what it found."""
