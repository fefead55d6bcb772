"""Runs one compiled loop: scan, the firmware's step, the command a constant delay later, the plant on to the next scan.

What is left out against a run over the wire: bytes, bus arbitration and its jitter, the scheduler, supervision. What
is kept: every converter's resolution, the round robin of the magnetometer's converter, the instant in the plant's
step at which a command arrives.
"""

from __future__ import annotations

import numpy as np

from firmware_py.control.chain import COMMANDED, step_kernel
from firmware_py.frame import (
    CLIP,
    CLIP_YIELD,
    COMMAND,
    COUNTS,
    MAGNETOMETER_FRESH,
    MAGNETOMETER_RAW,
    STATUS,
    TICK,
    TIME,
)
from firmware_py.records import Record
from hal.arrays import Array
from hal.compiled import kernel
from sim_devices.plant.kernel import STEPS_PER_MS, TRUTH_COLUMNS, advance, truth_row

WIRES = np.dtype(
    [
        ("counts_per_V", "f8"),  # of the DAQ
        ("field_lsb_V", "f8"),  # of the magnetometer's converter
        ("drive_lsb_V", "f8"),  # of the amplifier, at the stack
        ("drive_top", "f8"),  # its highest code
        ("delay_steps", "i8"),  # whole plant steps from scan to command
        ("delay_part", "f8"),  # and the part of the running step
        ("armed_tick", "i8"),  # the first one that commands
        ("tick", "i8"),
        ("clipped", "i8"),  # commands that ran into a limit
        ("field_start_V", "f8"),
        ("field_V", "f8", (3,)),
    ]
)


@kernel
def scan(s: Record, wires: Record, frame: Array) -> None:
    """Input columns of the frame at the present instant of the plant's state ``s``."""
    frame[TICK] = wires.tick
    frame[TIME] = wires.tick * 1e-3
    for i in range(8):
        counts = np.rint(s["daq_V"][i] * wires.counts_per_V)
        frame[COUNTS + i] = max(-32768.0, min(32767.0, counts))
    # one axis is converted at a time, begun at ticks 0, 3, 6 of ten and done a good millisecond later
    phase = wires.tick % 10
    fresh = phase == 1 and wires.tick > 10
    frame[MAGNETOMETER_FRESH] = 1.0 if fresh else 0.0
    if fresh:
        for i in range(3):
            frame[MAGNETOMETER_RAW + i] = wires.field_V[i]
    axis = phase // 3
    if axis < 3:
        if phase % 3 == 0:
            wires.field_start_V = s["magnetometer_V"][axis]
        elif phase % 3 == 1:
            mean = 0.5 * (wires.field_start_V + s["magnetometer_V"][axis])
            wires.field_V[axis] = np.rint(mean / wires.field_lsb_V) * wires.field_lsb_V
    frame[STATUS] = COMMANDED if wires.tick >= wires.armed_tick else 0


@kernel
def command(s: Record, wires: Record, frame: Array) -> None:
    """The frame's command reaches the amplifiers within the plant's running step, which sees the mean of both."""
    for i in range(3):
        code = min(np.floor(frame[COMMAND + i] / wires.drive_lsb_V + 0.5), wires.drive_top)
        volts = max(code, 0.0) * wires.drive_lsb_V
        s["demand_fix_V"][i] += wires.delay_part * (s["demand_V"][i] - volts)
        s["demand_V"][i] = volts


@kernel
def advance_finely(
    world: tuple[Record, Record, Array],
    block: tuple[Array, Array, Array, Array],
    steps: tuple[int, int],
    row: int,
    fine: Array,
) -> int:
    """Run ``steps`` as ``advance`` does, and write the tip and the rigid tip after each step to ``fine`` (8 n, 6), m.

    The play of the mount is taken up from where the last millisecond left it, so that the run stays the same.
    """
    plant, state, truth = world
    seat = state[0]["seat_m"]
    part, now, before = np.zeros(6), np.zeros(TRUTH_COLUMNS), np.zeros(3)
    for j in range(steps[0], steps[1]):
        row = advance(plant, state, block, (j, j + 1), truth, row)
        for i in range(3):
            before[i] = seat[i]
        truth_row(plant[0], state[0], part, now)
        for i in range(3):
            seat[i] = before[i]
        for i in range(6):
            fine[j, i] = now[i]
    return row


@kernel
def closed_loop(
    n: int,
    world: tuple[Record, Record, Array],
    block: tuple[Array, Array, Array, Array],
    row: int,
    kept: tuple[Array, Array],
    loop: tuple[Record, Record],
) -> int:
    """Run ``n`` ticks of 1 ms from the start of a ``block`` (``PlantBlocks``). Return the next free row of the truth.

    ``world``: plant, state and truth; ``loop``: the wires and the firmware's memory. ``kept``: the finished frames
    (n, Layout.size), and tip and rigid tip in every step of the plant (8 n, 6); an empty array (0, ...) takes nothing.
    """
    (plant, state, truth), (wire, memory), (frames, fine) = world, loop, kept
    s, wires, frame = state[0], wire[0], memory[0].frame
    for k in range(n):
        first = k * STEPS_PER_MS
        scan(s, wires, frame)
        step_kernel(memory)
        if len(frames) > 0:
            for i in range(len(frame)):
                frames[k, i] = frame[i]
        arrives = first + wires.delay_steps
        if len(fine) > 0:
            row = advance_finely(world, block, (first, arrives), row, fine)
        else:
            row = advance(plant, state, block, (first, arrives), truth, row)
        if wires.tick >= wires.armed_tick:
            command(s, wires, frame)
            if int(frame[CLIP]) & ~CLIP_YIELD:
                wires.clipped += 1
        if len(fine) > 0:
            row = advance_finely(world, block, (arrives, first + STEPS_PER_MS), row, fine)
        else:
            row = advance(plant, state, block, (arrives, first + STEPS_PER_MS), truth, row)
        wires.tick += 1
    return row
