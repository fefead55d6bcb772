"""Uses the whole emulated bench as a twin: commands and handle motion in, DAQ channels and tip position out.

Signals, each optional: inputs ``command_1..3`` (V, amplifier outputs asked for; 50 V where absent), ``path_x|y|z`` (m,
where the tip would be with the manipulator at rest, world frame) and ``angle_x|y|z`` (rad, small, about the attitude
in which the bench's hand holds the instrument); outputs ``volts_0..7`` (V at the DAQ) and ``tip_x|y|z`` (m). These are
the names that ``micron export`` gives. The physics is the bench file's ``[emulation]`` table without its noise.

``[twin.parameters]`` may also say ``hand = "bench"`` where no motion was recorded: the bench's own hand moves the
instrument (else it rests in a vice), and ``start_s``: how long the world had run at the first sample.
"""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from scipy.interpolate import CubicSpline

from hal.arrays import Array
from hal.bench import load_bench
from hal.errors import BenchError
from hal.trust import NotTrusted, path_inside
from sim_devices.config import EmulationConfig, emulation_config
from sim_devices.plant.hand import holding_frame
from sim_devices.plant.instrument import Instrument
from sim_devices.plant.recorded_hand import make_hand
from tools.errors import RecordingError
from tools.mismatch.keys import PARAMETERS, names
from tools.mismatch.recording import Recording
from tools.mismatch.twins.opaque import OpaqueTwin
from tools.mismatch.units import convert, same_dimension

NODE_S = 1e-3
NEUTRAL_V = 50.0
MOTION = ("path_x", "path_y", "path_z", "angle_x", "angle_y", "angle_z")
TIP = ("tip_x", "tip_y", "tip_z")
ALL_OUTPUTS = (*(f"volts_{i}" for i in range(8)), *TIP)
INPUTS = re.compile(r"command_[123]|path_[xyz]|angle_[xyz]")
OUTPUTS = re.compile(r"volts_[0-7]|tip_[xyz]")


class GivenHand:
    """Moves the handle as recorded, along cubic splines through the samples, so that derivatives are consistent."""

    def __init__(self, frame: Array, t_s: Array, coordinates: Array) -> None:
        self.frame = frame
        self._spline = CubicSpline(t_s - t_s[0], coordinates, axis=0)
        self._last_s = float(t_s[-1] - t_s[0])
        self._node = 0

    def _pose(self, first: int, n: int) -> Array:
        t = np.minimum((first + np.arange(n)) * NODE_S, self._last_s)
        return np.hstack([self._spline(t), self._spline(t, 1), self._spline(t, 2)])

    def start(self, pose: Array, parts: Array) -> None:
        """See ``sim_devices.plant.hand.Hand``."""
        pose[:] = self._pose(0, 1)[0]
        parts[:] = 0.0

    def fill(self, pose: Array, parts: Array) -> None:
        """See ``sim_devices.plant.hand.Hand``."""
        pose[:] = self._pose(self._node + 1, len(pose))
        parts[:] = 0.0
        self._node += len(pose)


def simulate_instrument(
    config: EmulationConfig,
    inputs: Mapping[str, Array],
    outputs: Sequence[str] = ALL_OUTPUTS,
    *,
    own_hand: bool = False,
    start_s: float = 0.0,
) -> dict[str, Array]:
    """Make a noiseless run. ``inputs`` holds ``t`` (n,) s and any of the twin's inputs (n,); returns ``outputs`` (n,).

    With ``own_hand`` the bench's own hand moves the instrument, not the ``inputs``; ``start_s`` is the time that its
    world had run before the first sample.
    """
    t_s = inputs["t"]
    n = len(t_s)
    resting = np.zeros(n)
    given = GivenHand(holding_frame(config.hand), t_s, np.column_stack([inputs.get(k, resting) for k in MOTION]))
    hand = make_hand(config.hand, config.seed, None, None) if own_hand else given
    instrument = Instrument(config, config.seed, hand, unit=config.unit, quiet=True)
    held = np.full(n, NEUTRAL_V)
    commands = np.column_stack([inputs.get(f"command_{i}", held) for i in (1, 2, 3)]).tolist()
    wants_volts = any(name.startswith("volts") for name in outputs)
    volts = np.empty((n, 8))
    sent = [float("nan")] * 3
    times_ns = np.round((t_s - t_s[0] + start_s) * 1e9).astype(np.int64)
    for k, t_ns in enumerate(times_ns.tolist()):
        instrument.advance_to(t_ns)
        if wants_volts:
            volts[k] = instrument.analog_V
        for channel, wanted in enumerate(commands[k]):
            if wanted != sent[channel]:
                instrument.set_demand_V(channel, wanted, t_ns)
        sent = commands[k]
    truth = instrument.truth()
    tip_m = [np.interp(times_ns, truth["t_ns"], truth["tip_m"][:, axis]) for axis in range(3)]
    everything = {f"volts_{i}": volts[:, i] for i in range(8)} | dict(zip(TIP, tip_m, strict=True))
    return {name: everything[name] for name in outputs}


def _si_unit(signal: str) -> str:
    return {"command": "V", "volts": "V", "path": "m", "tip": "m", "angle": "rad"}[signal.split("_")[0]]


def _world(recording: Recording) -> tuple[bool, float]:
    """Return if the bench's own hand moves the instrument, and the time that its world had run at the first sample."""
    given = recording.twin.parameters
    where = f"{recording.path}: [twin.parameters]"
    unknown = [k for k in given if k not in names(PARAMETERS["instrument"])]
    if unknown:
        raise RecordingError(f"{where} '{unknown[0]}' is not a parameter of instrument; known: bench, hand, start_s")
    hand, start_s = given.get("hand", "rest"), given.get("start_s", 0.0)
    if hand not in ("rest", "bench"):
        raise RecordingError(f"{where} hand must be 'rest' or 'bench', got {hand!r}")
    if hand == "bench" and any(s in MOTION for s in recording.inputs):
        raise RecordingError(f"{where} hand = 'bench': its motion was recorded too; leave one of them out")
    if isinstance(start_s, bool) or not isinstance(start_s, int | float) or not 0.0 <= start_s <= 3600.0:
        raise RecordingError(f"{where} start_s must be 0 to 3600 s, got {start_s!r}")
    return hand == "bench", float(start_s)


def bench_world(recording: Recording) -> tuple[EmulationConfig, bool, float]:
    """Return the emulated bench of ``[twin.parameters] bench``, if its own hand moves it, and its time in s at start.

    Raises RecordingError that names the faulty signal or file.
    """
    bench = recording.twin.parameters.get("bench")
    if not isinstance(bench, str):
        raise RecordingError(f"{recording.path}: [twin.parameters] bench must name the bench file, got {bench!r}")
    for signals, known, role in ((recording.inputs, INPUTS, "input"), (recording.outputs, OUTPUTS, "output")):
        for signal in signals:
            if not known.fullmatch(signal):
                raise RecordingError(
                    f"{recording.path}: the instrument twin has no {role} '{signal}'; "
                    f"it knows {known.pattern.replace('|', ', ')}; give other channels the role 'context'"
                )
            if not same_dimension(recording.unit[signal], _si_unit(signal)):
                raise RecordingError(
                    f"{recording.path}: {role} '{signal}' is in {recording.unit[signal]}, not a unit of the dimension "
                    f"of {_si_unit(signal)}"
                )
    own_hand, start_s = _world(recording)
    try:
        file = load_bench(path_inside(recording.path, bench))
        config = emulation_config(file.description.model_dump())
    except NotTrusted:
        raise
    except BenchError as error:
        raise RecordingError(f"{recording.path}: [twin.parameters] bench: {error}") from error
    return config, own_hand, start_s


def instrument_twin(recording: Recording) -> OpaqueTwin:
    """Load the bench that ``[twin.parameters] bench`` names. Raises RecordingError that names the faulty file."""
    config, own_hand, start_s = bench_world(recording)

    def call(inputs: Mapping[str, Array], parameters: Mapping[str, Any]) -> Mapping[str, Array]:
        si = {k: x if k == "t" else convert(x, recording.unit[k], _si_unit(k)) for k, x in inputs.items()}
        found = simulate_instrument(config, si, tuple(recording.outputs), own_hand=own_hand, start_s=start_s)
        return {k: convert(x, _si_unit(k), recording.unit[k]) for k, x in found.items()}

    return OpaqueTwin(
        kind="instrument",
        inputs=tuple(recording.inputs),
        outputs=tuple(recording.outputs),
        units=recording.unit,
        call=call,
        free=(),
        given=dict(recording.twin.parameters),
        parameters=(),
        source=str(Path(str(recording.twin.parameters["bench"]))),
    )
