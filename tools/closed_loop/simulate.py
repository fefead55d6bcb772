"""A run of the instrument without wires: the same bench file, hand and seed as ``micron run --virtual``, compiled."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from drivers.options import DacAmplifierOptions, Di4108Options, Hmc2003Options
from drivers.specs import check_devices
from firmware_py.control.plan import load_plan
from firmware_py.control.stages import StageConfigs, Stages
from firmware_py.control.wiring import sensing_table
from firmware_py.frame import LAYOUT
from firmware_py.records import Record, new_record
from firmware_py.sensing.config import SensingConfig
from hal.arrays import Array
from hal.bench import BenchFile
from sim_devices.config import emulation_config
from sim_devices.plant.blocks import PlantBlocks
from sim_devices.plant.kernel import STEP_S, STEPS_PER_MS, advance, outputs_later
from sim_devices.plant.recorded_hand import make_hand
from tools.closed_loop.kernel import WIRES, closed_loop
from tools.errors import InputError

COMMAND_DELAY_S = 497.5e-6
"""Scan to command of the default bench: 125 us of USB, 372.5 us on the I2C bus."""
SETTLE_MS = 12
OFFSET_READINGS = 4
READING_MS = 9
"""The magnetometer's offset before the run: strap, settling, four triples of three conversions each."""


@dataclass(frozen=True)
class SimulatedRun:
    """``truth`` as of a run over the wire; ``frames`` (n, Layout.size) where they were asked for, one a tick.

    ``fine`` (8 n, 6), where asked for: tip and rigid tip, m, after every step of the plant from ``started_ns`` on. The
    truth, once a millisecond at the instant of a scan, shows the actuators' resonance (550 to 750 Hz) at another
    frequency and always in one phase of the command.
    """

    truth: dict[str, NDArray]
    started_ns: int
    armed_ns: int
    safe_ns: int
    clipped: int
    frames: Array | None
    configs: StageConfigs
    fine: Array | None = None


def wires_of(bench: BenchFile, armed_tick: int, delay_s: float) -> Record:
    """The converters' numbers (dtype ``WIRES``). ``InputError`` for a bench whose output is not the DAC amplifier."""
    where = str(bench.path)
    options: dict[str, Any] = dict(check_devices(bench.description, where))

    def only(kind: type, what: str) -> Any:
        found = [name for name, option in options.items() if isinstance(option, kind)]
        if len(found) != 1:
            raise InputError(f"{where}: a run without wires needs exactly one {what}, this bench has {len(found)}")
        return found[0]

    magnetometer = bench.description.device[only(Hmc2003Options, "hmc2003")]
    daq, adc = options[only(Di4108Options, "di4108")], options[magnetometer.adc or ""]
    amplifier = options[only(DacAmplifierOptions, "dac_amplifier")]
    tick_hz = bench.description.clock.tick_hz
    if tick_hz != 1000 or daq.rate_hz != tick_hz or tuple(daq.channels) != tuple(range(8)):
        raise InputError(
            f"{where}: without wires the tick and the DAQ are at 1000 Hz and channels are 0 to 7 in order; use"
            " micron run --virtual for this bench"
        )
    if not 0.0 <= delay_s < STEPS_PER_MS * STEP_S:
        raise InputError(f"a delay of {1e3 * delay_s:g} ms: it is 0 or more and less than a tick of 1 ms")
    steps, rest_s = divmod(delay_s, STEP_S)
    return new_record(
        WIRES,
        counts_per_V=32768.0 / daq.range_V,
        field_lsb_V=adc.full_scale_V / 32768.0,
        drive_lsb_V=5.0 * amplifier.gain / 65536.0,
        drive_top=65535.0,
        delay_steps=int(steps),
        delay_part=rest_s / STEP_S,
        armed_tick=armed_tick,
    )


def _measure_offset(world: PlantBlocks) -> tuple[Array, int]:
    """(3,) V of the magnetometer's bridges, from readings after a set and a reset pulse; the milliseconds it took."""
    state, at = world.state[0], 0
    mean = np.zeros(3)
    for strap in (-1.0, 1.0):
        state["strap"] = strap
        for wait_ms in (SETTLE_MS, *(READING_MS,) * OFFSET_READINGS):
            _advance(world, at, at + wait_ms)
            at += wait_ms
            outputs_later(world.plant, world.state, 0.0)
            if wait_ms == READING_MS:
                mean += state["magnetometer_V"] / (2 * OFFSET_READINGS)
    return mean, at


def _advance(world: PlantBlocks, start_ms: int, stop_ms: int) -> None:
    steps = start_ms * STEPS_PER_MS, stop_ms * STEPS_PER_MS
    advance(world.plant, world.state, world.block, steps, world.truth, start_ms + 1)


def simulate(
    bench: BenchFile,
    seconds: float,
    *,
    seed: int | None = None,
    hand_file: str | None = None,
    hand_scale: float | None = None,
    delay_s: float = COMMAND_DELAY_S,
    method: str | None = None,
    keep_frames: bool = False,
    keep_fine: bool = False,
    on_time: Callable[[float], None] | None = None,
    on_block: Callable[[Array, Array], None] | None = None,
) -> SimulatedRun:
    """``seconds`` in closed loop after arming. Same arguments, same bits. ``method``: another tremor estimator.

    Raises ``BenchError`` or ``InputError`` for a bench that is not this instrument. ``on_time`` hears the seconds done.
    ``on_block`` gets the truth (n, TRUTH_COLUMNS) and the frames (n, Layout.size) of n ticks at a time; then nothing is
    kept, and a run may take as long as it likes.
    """
    table = bench.description.model_dump()
    if seed is not None:
        table["emulation"]["seed"] = seed
    emulation = emulation_config(table)
    if emulation.endoscope is not None:
        raise InputError(f"{bench.path}: an endoscope has no closed loop against tremor; use micron run --bench FILE")
    plan = load_plan(bench, method)
    configs = plan.stages
    watch = round(plan.firmware.self_test.watch_ms)
    wire = wires_of(bench, watch, delay_s)
    ticks = watch + round(1000.0 * seconds)
    hand = make_hand(emulation.hand, emulation.seed, hand_file, hand_scale)
    ms = 256
    world = PlantBlocks(emulation, hand, (ticks if on_block is None else 0) + 2 * ms)
    world.next_block()
    offset_V, before = _measure_offset(world)
    sensing = SensingConfig.model_validate(
        {**configs.sensing.model_dump(), **sensing_table_of(bench), "magnetometer_bias_V": offset_V.tolist()}
    )
    stages = Stages(StageConfigs(sensing, configs.tremor, configs.actuation))
    _advance(world, before, ms)  # scans begin with a block
    size = LAYOUT.size
    frames = np.zeros((ms if on_block is not None else ticks if keep_frames else 0, size))
    fine = np.zeros((STEPS_PER_MS * ticks if keep_fine else 0, 6))
    row, done = ms + 1, 0
    while done < ticks:
        world.next_block()
        n = min(ms, ticks - done)
        part = frames[:n] if on_block is not None else frames[done : done + n]
        arrays = world.plant, world.state, world.truth
        finely = fine[STEPS_PER_MS * done : STEPS_PER_MS * (done + n)]
        row = closed_loop(n, arrays, world.block, row, (part, finely), (wire, stages.memory))
        done += n
        if on_block is not None:
            on_block(world.truth[ms + 1 : row], part)
            row = ms + 1
        if on_time is not None:
            on_time(done * 1e-3)
    start_ns = ms * 1_000_000
    return SimulatedRun(
        truth=world.truth_columns(row),
        started_ns=start_ns,
        armed_ns=start_ns + watch * 1_000_000,
        safe_ns=start_ns + ticks * 1_000_000,
        clipped=int(wire["clipped"][0]),
        frames=frames if keep_frames else None,
        configs=stages.configs,
        fine=fine if keep_fine else None,
    )


def sensing_table_of(bench: BenchFile) -> dict[str, Any]:
    """Return the sensing table of the wiring, as the opened bench has it."""
    options = check_devices(bench.description, str(bench.path))
    daq = next(o for o in options.values() if isinstance(o, Di4108Options))
    return sensing_table(options, daq.channels, daq.rate_hz, daq.range_V / 32768.0, str(bench.path))
