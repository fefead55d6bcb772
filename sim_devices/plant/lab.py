"""Makes calibration recordings of the same physical unit as the bench, with the lab's measuring instruments.

``python -m sim_devices.plant.lab piezo --out FOLDER [--axis N] [--profile sawtooth|sine|tremor|loops|steps|set]
[--twin FILE]``
drives one stack through its amplifier under an interferometer (0.07 um rms, Ang 2004 sec. 7.4) and writes a recording
of the contract; ``steps``: small ones, read at 8 kHz so that a resonance shows; ``set`` writes a folder of them,
saw-teeth and sines of 0.1 to 40 Hz, loops and steps, all that a calibration needs. With ``--twin`` a corrected twin
(``micron mismatch apply``) stands in the stack's place, as with a bench that names it. ``... manipulator --out FOLDER``
moves all three stacks through a grid and tracks the tip. ``... tumble --out FOLDER`` turns the resting instrument
through many attitudes on two rotary stages (Ang 2004 sec. 3.2.1.7) and logs all 8 DAQ channels and the 3 magnetometer
outputs with the stage angles. ``... rest --out FOLDER`` and ``... pivot --out FOLDER`` log the same at 1 kHz, lying
still or swung about the tip.
"""

from __future__ import annotations

import argparse
import math
import sys
import tomllib
from pathlib import Path

import numpy as np
from pydantic import ValidationError

from hal.arrays import Array
from hal.compiled import kernel
from hal.errors import BenchError
from hal.validation import describe_validation_error
from sim_devices.config import EmulationConfig, HandConfig
from sim_devices.plant.hand import NODE_S, SyntheticHand
from sim_devices.plant.kernel import STEP_S, TRUTH_COLUMNS, begin, outputs
from sim_devices.plant.lab_motion import measure_motion
from sim_devices.plant.lab_scan import measure_scan
from sim_devices.plant.stack import drive_channel, drive_step, stack_unit
from sim_devices.plant.streams import stream
from sim_devices.plant.unit import build_unit, plant_arrays, start_temperature_C
from sim_devices.twin_file import FileTwin, load_twin

INTERFEROMETER_RMS_UM = 0.07
RATE_HZ = 1000.0
STEPS_HZ = 8000.0
STEPS_SHARE = 0.05
"""Amplitude of profile "steps" as a fraction of the demanded one: the amplifier's slew limit does not slow it down."""


class LabError(BenchError):
    """A measurement was asked for that cannot be made."""


@kernel
def drive_stack(params, state, volts, temperature_C, steps_per_sample, out):
    """Drive one stack with held demands ``volts`` (n,). ``out``: its stroke (n,) m and its voltage (n,) at each
    sample's time.

    Sample i is taken when its demand is given, so the answer to demand i shows from sample i + 1 on.
    """
    p, s = params[0], state[0]
    stroke, terminal_V = out
    for i in range(volts.shape[0]):
        stroke[i] = s["mode"][0]
        terminal_V[i] = s["stack_V"]
        for _ in range(steps_per_sample):
            drive_step(p, s, volts[i], temperature_C)


def sample_rate_hz(profile: str) -> float:
    """Return the sample rate of the demand and of the interferometer in Hz."""
    return STEPS_HZ if profile == "steps" else RATE_HZ


def drive_profile(profile: str, rate_hz: float, seconds: float, amplitude_V: float, seed: int) -> Array:
    """Return the demand (n,) in V about 50 V at ``sample_rate_hz``: triangle (``sawtooth``), sine of growing amplitude,
    tremor, loops or small steps."""
    t = np.arange(round(seconds * sample_rate_hz(profile))) / sample_rate_hz(profile)
    if profile == "steps":
        return 50.0 + STEPS_SHARE * amplitude_V * np.where((rate_hz * t) % 1.0 < 0.5, 1.0, -1.0)
    grow = np.minimum(1.0, t / max(0.2 * seconds, 1.0 / rate_hz))
    phase = rate_hz * t
    if profile == "sawtooth":
        return 50.0 + amplitude_V * grow * (2.0 * np.abs(2.0 * ((phase + 0.25) % 1.0) - 1.0) - 1.0)
    if profile == "sine":
        return 50.0 + amplitude_V * grow * np.sin(2.0 * math.pi * phase)
    if profile == "tremor":
        hand = SyntheticHand(HandConfig(tremor_frequency_hz=rate_hz, tremor_frequency_spread_hz=0.0), seed)
        pose, parts = np.zeros((len(t), 18)), np.zeros((len(t), 6))
        hand.fill(pose, parts)
        wave = grow * parts[:, 5]
        return 50.0 + amplitude_V * wave / np.max(np.abs(wave))
    if profile == "loops":
        # two full sweeps, then loops that shrink again and again about a centre that wanders: every minor loop once
        rest = np.maximum(t / seconds - 0.1, 0.0) / 0.9
        size = amplitude_V * 0.04 ** ((4.0 * rest) % 1.0)
        wander = (amplitude_V - size) * np.sin(2.0 * math.pi * 0.031 * rate_hz * t)
        loops = 50.0 + size * np.sin(2.0 * math.pi * phase) + 0.9 * wander
        return np.where(rest > 0.0, loops, 50.0 - amplitude_V * np.cos(4.0 * math.pi * t / (0.1 * seconds)))
    raise LabError(f"profile '{profile}': it is sawtooth, sine, tremor, loops or steps")


CALIBRATION_SET = (
    *(("sawtooth", hz, seconds, 1.0) for hz, seconds in ((0.1, 25.0), (0.3, 12.0), (1.0, 7.0), (2.0, 5.0), (5.0, 4.0))),
    *(("sawtooth", hz, 4.0, 1.0) for hz in (10.0, 15.0, 20.0, 30.0, 40.0)),
    *(("sine", hz, 4.0, 1.0) for hz in (2.0, 10.0, 25.0)),
    ("loops", 10.0, 20.0, 1.0),
    *(("sine", hz, 4.0, share) for hz, share in ((1.0, 0.3), (8.0, 0.3), (12.0, 0.15))),
    ("steps", 10.0, 4.0, 1.0),
)
"""Profile, Hz, seconds, share of the amplitude: rates as in Ang 2004, sec. 7.4, minor loops, loops of a tremor's size
about neutral, and steps for lag and resonance."""


def measure_piezo(
    config: EmulationConfig,
    axis: int,
    profile: str,
    rate_hz: float,
    seconds: float,
    amplitude_V: float,
    *,
    twin: FileTwin | None = None,
) -> tuple[dict[str, Array], str]:
    """Return the columns (n,) of the recording and its ``recording.toml``. A corrected piezo ``twin`` may replace the
    stack."""
    if axis not in (0, 1, 2):
        raise LabError(f"axis {axis}: the stacks are 0, 1 and 2")
    if not 0.0 < rate_hz <= 200.0:
        raise LabError(f"rate {rate_hz:g} Hz: give 0 < rate <= 200 Hz (sampled at {RATE_HZ:g} Hz)")
    if not seconds * rate_hz >= 1.0:
        raise LabError(f"{seconds:g} s hold no full cycle of {rate_hz:g} Hz")
    if seconds > 3600.0:
        raise LabError(f"{seconds:g} s: the lab closes after an hour (3600 s)")
    if not 0.0 < amplitude_V <= 50.0:
        raise LabError(f"amplitude {amplitude_V:g} V about 50 V: give 0 < amplitude <= 50 V")
    volts = drive_profile(profile, rate_hz, seconds, amplitude_V, config.seed)
    what = f"{profile} {rate_hz:g} Hz, {amplitude_V:g} V about 50 V"
    noise = f"{profile}.{rate_hz:g}"
    return measure_volts(config, axis, volts, sample_rate_hz(profile), noise=noise, what=what, twin=twin)


def measure_volts(
    config: EmulationConfig, axis: int, volts: Array, read_hz: float, *, noise: str, what: str, twin: FileTwin | None
) -> tuple[dict[str, Array], str]:
    """Return the columns (n,) of a recording with the demands ``volts`` (n,) at ``read_hz``, and its
    ``recording.toml``. ``noise`` names the stream of the interferometer's noise, ``what`` the demands in the title.
    """
    temperature_C = start_temperature_C(config)
    room_C = np.full(len(volts), temperature_C)
    if twin is not None:
        if twin.kind != "piezo_stack":
            raise LabError(f"{twin.path}: a twin of kind {twin.kind}; the interferometer measures a piezo_stack")
        stroke = 1e-6 * twin.run(1.0 / read_hz, {"command": volts, "temperature": room_C})["displacement"]
    else:
        unit = stack_unit(config.stack, config.unit, axis)
        params, state = drive_channel(unit, config.amplifier, STEP_S, temperature_C)
        stroke, terminal_V = np.empty(len(volts)), np.empty(len(volts))
        drive_stack(params, state, volts, temperature_C, round(1.0 / (read_hz * STEP_S)), (stroke, terminal_V))
    hiss = stream(config.seed, f"lab.piezo.{axis}.{noise}").standard_normal(len(volts))
    columns = {
        "command_V": volts,
        "displacement_um": stroke * 1e6 + INTERFEROMETER_RMS_UM * hiss,
        "temperature_C": room_C,
    }
    descriptor = f"""format = 1
title = "piezo stack {axis} of unit {config.unit}, {what}"
data = "data.npz"
rate_hz = {read_hz}

[twin]
kind = "piezo_stack"
[twin.parameters]
gain_um_per_V = {config.stack.stroke_um_at_100_V / 100.0}
offset_um = 0.0
hold = "zero"

[[channels]]
column = "command_V"
role = "input"
signal = "command"
unit = "V"

[[channels]]
column = "displacement_um"
role = "output"
signal = "displacement"
unit = "um"
noise_rms = {INTERFEROMETER_RMS_UM}

[[channels]]
column = "temperature_C"
role = "context"
signal = "temperature"
unit = "degC"
"""
    return columns, descriptor


def measure_rest_V(config: EmulationConfig, axis: int) -> float:
    """Return what a voltmeter shows at the terminals of stack ``axis`` while its amplifier is told its neutral."""
    unit = stack_unit(config.stack, config.unit, axis)
    return float(drive_channel(unit, config.amplifier, STEP_S, start_temperature_C(config))[1][0]["stack_V"])


def tumble_attitudes(positions: int) -> tuple[Array, Array]:
    """Return stage angles (n, 2) in rad, about z then y, and attitudes (n, 3, 3): evenly spread directions of gravity.

    The order jumps about, so that a drift during the recording does not look like one of the axes.
    """
    stride = next(k for k in range(round(0.618 * positions), 2 * positions) if math.gcd(k, positions) == 1)
    n = (np.arange(positions) * stride % positions).astype(np.float64)
    polar: Array = np.arccos(1.0 - 2.0 * (n + 0.5) / positions)
    turn = math.pi * (3.0 - math.sqrt(5.0)) * n % (2.0 * math.pi)
    angles: Array = np.stack([turn, polar], axis=1).astype(np.float64)
    frames = np.empty((positions, 3, 3))
    for i, (a, b) in enumerate(angles):
        ca, sa, cb, sb = math.cos(a), math.sin(a), math.cos(b), math.sin(b)
        frames[i] = np.array([[cb, 0.0, sb], [0.0, 1.0, 0.0], [-sb, 0.0, cb]]) @ np.array(
            [[ca, -sa, 0.0], [sa, ca, 0.0], [0.0, 0.0, 1.0]]
        )
    return angles, frames


def measure_tumble(config: EmulationConfig, positions: int, seconds: float) -> tuple[dict[str, Array], str]:
    """Mean over ``seconds`` at each position (5 s in Ang 2004), with the true attitude of the stages."""
    if not 12 <= positions <= 10_000:
        raise LabError(f"{positions} positions: give 12 to 10000")
    if not 0.01 <= seconds <= 60.0:
        raise LabError(f"{seconds:g} s per position: give 0.01 to 60 s")
    angles, frames = tumble_attitudes(positions)
    analog, magnet, turned = np.empty((positions, 8)), np.empty((positions, 3)), np.empty((positions, 3))
    samples = round(seconds / NODE_S)
    plant, state = plant_arrays(config, build_unit(config, config.unit), frames[0])
    spread_V = _mean_noise_V(config, samples)
    rng, strap_rng = stream(config.seed, "lab.tumble"), stream(config.seed, "lab.tumble.strap")
    still, truth = np.zeros(18), np.zeros(TRUTH_COLUMNS)
    for i in range(positions):
        plant[0]["frame"] = frames[i]
        begin(plant, state, still, still[:6], truth)
        noise = spread_V * rng.standard_normal(11)
        analog[i], magnet[i] = state[0]["daq_V"] + noise[:8], state[0]["magnetometer_V"] + noise[8:]
        # the strap's reset pulse turns the sign of the sensitivity, not of the bridge's offset
        state[0]["strap"] = -1.0
        outputs(plant[0], state[0], 0.0)
        turned[i] = state[0]["magnetometer_V"] + spread_V[8:] * strap_rng.standard_normal(3)
        state[0]["strap"] = 1.0
    columns = {
        "stage_z_rad": angles[:, 0],
        "stage_y_rad": angles[:, 1],
        "attitude": frames,
        "analog_V": analog,
        "magnetometer_V": magnet,
        "magnetometer_reset_V": turned,
    }
    descriptor = f"""format = 1
title = "tumble of unit {config.unit}: {positions} positions, mean of {samples} samples each"
data = "data.npz"
gravity_m_s2 = {config.environment.gravity_m_s2}
# attitude (n, 3, 3): body to world = Ry(stage_y) Rz(stage_z)
# analog_V (n, 8): a1x, a1z, a2y, a2z, a3x, a3y, supply / 2, TMP36; magnetometer_V (n, 3), after a set pulse
# magnetometer_reset_V (n, 3): after a reset pulse
"""
    return columns, descriptor


def _mean_noise_V(config: EmulationConfig, samples: int) -> Array:
    """(11,) rms of the mean of ``samples`` milliseconds at rest: no need to run them one by one."""
    sensors = config.sensors
    # behind the RC the noise still has its density D at low frequency: the mean over T has variance D^2 / (2 T)
    tau_s = sensors.rc_ohm * sensors.rc_farad
    density = sensors.noise_ug_per_rtHz * 1e-6
    spread = np.full(11, sensors.daq_noise_uV * 1e-6 / math.sqrt(samples))
    spread[:6] = np.hypot(spread[:6], density / math.sqrt(2.0 * max(samples * NODE_S, 2.0 * tau_s)))
    spread[8:] = sensors.magnetometer_noise_uG * 1e-6 / math.sqrt(samples)
    return spread


def load_config(bench: Path | None, unit: int | None) -> EmulationConfig:
    """Return the ``[emulation]`` table of a bench file, or the defaults. ``unit`` overrides its unit."""
    table: dict[str, object] = {}
    if bench is not None:
        try:
            table = dict(tomllib.loads(bench.read_text(encoding="utf-8-sig")).get("emulation", {}))
        except (OSError, UnicodeDecodeError, tomllib.TOMLDecodeError) as error:
            raise LabError(f"{bench}: {error}") from error
    if unit is not None:
        table["unit"] = unit
    try:
        return EmulationConfig.model_validate(table)
    except ValidationError as error:
        raise LabError(describe_validation_error(error, f"{bench or '--unit'}: [emulation]")) from error


def in_place(config: EmulationConfig, bench: Path | None, axis: int, given: Path | None) -> FileTwin | None:
    """The corrected twin that stands in for a stack: the one ``given``, else what the bench names, else none."""
    named = config.twin if config.twin is None or isinstance(config.twin, str) else config.twin[axis % 3]
    if given is not None or named is None:
        return None if given is None else load_twin(given)
    return load_twin((bench.parent if bench is not None else Path()) / named)


def write_recording(folder: Path, columns: dict[str, Array], descriptor: str) -> None:
    try:
        folder.mkdir(parents=True, exist_ok=True)
        np.savez_compressed(folder / "data.npz", **columns)  # pyright: ignore[reportArgumentType]
        (folder / "recording.toml").write_text(descriptor)
    except OSError as error:
        raise LabError(f"cannot write to {folder}: {error}") from error


def main(arguments: list[str] | None = None) -> int:
    parser = argparse.ArgumentParser(prog="python -m sim_devices.plant.lab", description=__doc__)
    what = parser.add_subparsers(dest="what", required=True)
    piezo = what.add_parser("piezo", help="one stack under the interferometer")
    piezo.add_argument("--axis", type=int, default=0)
    piezo.add_argument("--profile", choices=("sawtooth", "sine", "tremor", "loops", "steps", "set"), default="sine")
    piezo.add_argument("--rate-hz", type=float, default=10.0)
    piezo.add_argument("--seconds", type=float, default=10.0)
    piezo.add_argument("--amplitude-V", type=float, default=41.7, help="half of peak to peak, about 50 V")
    piezo.add_argument("--twin", type=Path, help="corrected twin (micron mismatch apply) instead of the unit's stack")
    tumble = what.add_parser("tumble", help="the resting instrument in many attitudes")
    tumble.add_argument("--positions", type=int, default=100)
    tumble.add_argument("--seconds", type=float, default=5.0, help="averaging at each position")
    scan = what.add_parser("manipulator", help="the tip over a grid of voltages")
    scan.add_argument("--per-axis", type=int, default=5, help="voltages per stack")
    rest = what.add_parser("rest", help="the instrument lying still, at 1 kHz")
    pivot = what.add_parser("pivot", help="the instrument swung about its tip, at 1 kHz")
    rest.add_argument("--seconds", type=float, default=600.0)
    pivot.add_argument("--seconds", type=float, default=60.0)
    for command in (piezo, tumble, scan, rest, pivot):
        command.add_argument("--out", type=Path, required=True, help="folder to write to")
        command.add_argument("--bench", type=Path, help="bench file whose [emulation] table describes the unit")
        command.add_argument("--unit", type=int, help="the unit, if not the bench's")
    given = parser.parse_args(arguments)
    try:
        config = load_config(given.bench, given.unit)
        twin = in_place(config, given.bench, given.axis, given.twin) if given.what == "piezo" else None
        if given.what == "piezo" and given.profile == "set":
            for profile, rate_hz, seconds, share in CALIBRATION_SET:
                columns, descriptor = measure_piezo(
                    config, given.axis, profile, rate_hz, seconds, share * given.amplitude_V, twin=twin
                )
                write_recording(given.out / f"{profile}-{rate_hz:g}Hz", columns, descriptor)
            sys.stderr.write(f"{given.out}: {len(CALIBRATION_SET)} recordings\n")
            return 0
        if given.what == "manipulator":
            if not 3 <= given.per_axis <= 12:
                raise LabError(f"{given.per_axis} voltages per axis: give 3 to 12")
            columns, descriptor = measure_scan(config, given.per_axis, stream(config.seed, "lab.manipulator"))
        elif given.what in ("rest", "pivot"):
            columns, descriptor = measure_motion(config, given.what, given.seconds)
        elif given.what == "piezo":
            columns, descriptor = measure_piezo(
                config, given.axis, given.profile, given.rate_hz, given.seconds, given.amplitude_V, twin=twin
            )
        else:
            columns, descriptor = measure_tumble(config, given.positions, given.seconds)
        write_recording(given.out, columns, descriptor)
    except BenchError as error:
        sys.stderr.write(f"lab: {error}\n")
        return 2
    sys.stderr.write(f"{given.out / 'recording.toml'}: {len(next(iter(columns.values())))} rows\n")
    return 0


if __name__ == "__main__":
    sys.exit(main())
