"""Finds changes for which the firmware has no remedy: an amplifier that its monitor stops, a gain that follows
temperature, a play in the mount.

The gain is measured in a climate chamber at ``WARMER_K`` about the room's temperature. The play is what the engine
names in the tip's record after the best geometry has been taken off.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from scipy.stats import linregress

from drivers.options import AmplifierMonitorOptions
from drivers.specs import check_devices
from sim_devices.config import EmulationConfig
from sim_devices.plant.lab import drive_profile, in_place, measure_rest_V, measure_volts
from sim_devices.plant.lab_tip import TIP_HZ, measure_tip
from tools.calibrate.manipulator import NAMES, identify_manipulator, load_scan, tip_um
from tools.heal.parts import AMPLITUDE_V, Lab, scan_tip
from tools.mismatch.infer import diagnose
from tools.mismatch.recording import Recording
from tools.mismatch.recording_load import from_table

WARMER_K = (-6.0, -3.0, 0.0, 3.0, 6.0)
LOOPS_S, LOOPS_HZ = 8.0, 1000.0
LEVEL = 1e-3
"""Level of the test of a slope against temperature, over all three stacks."""
TIP_S = 40.0


def name_stacks(lab: Lab, jobs: int = 1) -> tuple[str, ...]:
    """Name what calibrations of stacks cannot put right."""
    return (*name_output(lab), *name_temperature(lab, jobs))


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


def name_temperature(lab: Lab, jobs: int = 1) -> tuple[str, ...]:
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


def name_play(lab: Lab, jobs: int = 1) -> tuple[str, ...]:
    """Name what the engine finds in the tip's motion beyond any geometry."""
    report = diagnose(beyond_geometry(lab), jobs=jobs)
    return tuple(dict.fromkeys(f"{p.name.replace('_', ' ')} between manipulator and tip" for p in report.physics))


def beyond_geometry(lab: Lab) -> Recording:
    """Return the tip's motion across the shaft beside that of the geometry that fits the lab's scan best."""
    fit = identify_manipulator(load_scan(scan_tip(lab)))
    columns = measure_tip(lab.config, TIP_S)
    modelled = tip_um(np.array([fit.parameters[n].value for n in NAMES]), columns["stroke_um"])
    table: dict[str, np.ndarray] = {}
    channels: list[dict[str, Any]] = []
    for i, axis in enumerate("xy"):
        table |= {f"model_{axis}": modelled[:, i], f"tip_{axis}": columns["tip_um"][:, i]}
        channels += [
            {"column": f"model_{axis}", "role": "input", "signal": f"simulated_tip_{axis}", "unit": "um"},
            {"column": f"tip_{axis}", "role": "output", "signal": f"tip_{axis}", "unit": "um"},
        ]
    text = {
        "format": 1, "rate_hz": TIP_HZ, "title": "tip beside the fitted geometry",
        "twin": {"kind": "columns"}, "channels": channels,
    }  # fmt: skip
    return from_table(lab.folder / "tip", text, table)


WITHOUT_REMEDY = {"stacks": name_stacks, "manipulator": name_play}
"""Experiments by the part beside which they are made. Each returns the names of what it found."""
