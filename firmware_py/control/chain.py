"""The step of the instrument: sense, estimate, actuate as one compiled call over one frame.

The live loop calls ``step_kernel`` once a tick; replay and batches loop the same kernel inside compiled code
(``run_kernel``). There is no second implementation, so the three give the same numbers bit for bit. The step calls each
stage at an address in its memory: the stages are compiled by themselves, and no caller of the step compiles them again.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

from firmware_py.actuation.stage import actuate_kernel, rest_kernel
from firmware_py.control.manual import follow_kernel
from firmware_py.frame import COMMAND, LAYOUT, STATUS, VOLTS, FrameStatus
from firmware_py.records import Record
from firmware_py.sensing.stage import sense_kernel
from firmware_py.tremor.detectors import detect_kernel
from firmware_py.tremor.stage import estimate_kernel, learn_kernel
from hal.compiled import kernel
from hal.kernel_calls import call_entry, entry

COMMANDED = int(FrameStatus.COMMANDED)
MANUAL = int(FrameStatus.MANUAL)
HELD = int(FrameStatus.HELD)
GIVEN_BITS = int(FrameStatus.GAP | FrameStatus.STALE) | COMMANDED | MANUAL | HELD
"""Bits of ``status`` that the caller sets before a step; the kernels add the others."""


PARTS = ("sense", "estimate", "detect", "actuate")
KERNELS = (sense_kernel, estimate_kernel, detect_kernel, actuate_kernel)


def memory_dtype(parts: Sequence[tuple[np.dtype[Any], np.dtype[Any]]]) -> np.dtype[Any]:
    """The frame and each stage's ``NAME_state``, ``NAME_params`` and ``NAME_entry`` (the address of its code, see
    ``bind``), and ``learn_entry`` of ``learn_after_step``. States and parameters are given as dtypes in the order of
    ``PARTS``.

    One record for all, because each array that Python hands to a compiled kernel costs about 0.35 us a call.
    """
    fields: list[Any] = [("frame", "f8", (LAYOUT.size,))]
    for name, (state, params) in zip(PARTS, parts, strict=True):
        fields += [(f"{name}_state", state, (1,)), (f"{name}_params", params, (1,)), (f"{name}_entry", "i8")]
    fields.append(("learn_entry", "i8"))
    return _the_one(np.dtype(fields))


@cache
def _the_one(dtype: np.dtype[Any]) -> np.dtype[Any]:
    """The first of all dtypes that are equal to this one. Numba looks up a record's type by its dtype at every call,
    and to find that two objects are equal takes 100 us, twenty times as long as the step."""
    return dtype


def bind(memory: Record) -> None:
    """Compile or load the stages' kernels and write their addresses to ``memory``. A step needs them."""
    m = memory[0]
    for name, stage in zip(PARTS, KERNELS, strict=True):
        m[f"{name}_entry"] = entry(stage, m["frame"], m[f"{name}_state"], m[f"{name}_params"])
    m["learn_entry"] = entry(learn_kernel, m["frame"], m["estimate_state"], m["estimate_params"])


@kernel
def step_kernel(memory: Record) -> None:
    """Compute one tick: the frame's columns left of the volts and the ``GIVEN_BITS`` of its status are the input.

    COMMANDED: a command is computed. MANUAL: ``command`` is given and the actuation stage follows it. HELD: the same,
    and compensation begins where the outputs are then. None: the outputs are not free to move, or a newer scan is there
    already; the last command stays in its column.
    ``memory`` (1,) is of ``memory_dtype`` and bound.
    """
    m = memory[0]
    frame = m.frame
    if m.sense_entry == 0:
        raise RuntimeError("the memory is not bound")
    call_entry(m.sense_entry, frame, m.sense_state, m.sense_params)
    call_entry(m.estimate_entry, frame, m.estimate_state, m.estimate_params)
    call_entry(m.detect_entry, frame, m.detect_state, m.detect_params)
    status = int(frame[STATUS])
    if status & COMMANDED:
        call_entry(m.actuate_entry, frame, m.actuate_state, m.actuate_params)
    elif status & (MANUAL | HELD):
        follow_kernel(frame, m.actuate_state, m.actuate_params)
        if status & HELD:
            rest_kernel(m.actuate_state)


@kernel
def learn_after_step(memory: Record) -> None:
    """Do the part of the next step that needs no new scan, when the command of this one is on its way. The numbers are
    the same without it; the next command is later by up to 0.1 ms."""
    m = memory[0]
    call_entry(m.learn_entry, m.frame, m.estimate_state, m.estimate_params)


@kernel
def run_kernel(rows: NDArray[np.float64], memory: Record) -> None:
    """``step_kernel`` over ``rows`` (n, Layout.size), in place: inputs in, the whole frame out.

    The memory's frame is the running one: a column that a tick does not write keeps the last tick's value, as in the
    live loop.
    """
    frame = memory[0].frame
    for k in range(len(rows)):
        row = rows[k]
        status = int(row[STATUS]) & GIVEN_BITS
        for i in range(VOLTS):
            frame[i] = row[i]
        frame[STATUS] = status
        if status & (MANUAL | HELD):
            for i in range(COMMAND, COMMAND + 3):
                frame[i] = row[i]
        step_kernel(memory)
        for i in range(len(frame)):
            row[i] = frame[i]
