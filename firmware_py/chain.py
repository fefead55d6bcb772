"""The step of the instrument: sense, estimate, actuate as one compiled call over one frame.

The live loop calls ``step_kernel`` once a tick; replay and batches loop the same kernel inside compiled code
(``run_kernel``). There is no second implementation, so the three give the same numbers bit for bit.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from firmware_py.actuation.stage import actuate_kernel
from firmware_py.control.manual import follow_kernel
from firmware_py.frame import COMMAND, STATUS, VOLTS, FrameStatus
from firmware_py.records import Record
from firmware_py.sensing.stage import sense_kernel
from firmware_py.tremor.detectors import detect_kernel
from firmware_py.tremor.stage import estimate_kernel
from hal.compiled import kernel

COMMANDED = int(FrameStatus.COMMANDED)
MANUAL = int(FrameStatus.MANUAL)
GIVEN_BITS = int(FrameStatus.GAP | FrameStatus.STALE | FrameStatus.COMMANDED | FrameStatus.MANUAL)
"""Bits of ``status`` that the caller sets before a step; the kernels add the others."""


@kernel
def step_kernel(
    frame: NDArray[np.float64],
    sense_state: Record,
    sense_params: Record,
    estimate_state: Record,
    estimate_params: Record,
    detect_state: Record,
    detect_params: Record,
    actuate_state: Record,
    actuate_params: Record,
) -> None:
    """One tick: the frame's columns left of the volts and the ``GIVEN_BITS`` of its status are the input.

    COMMANDED: a command is computed. MANUAL: ``command`` is given and the actuation stage follows it. Neither: the
    outputs are not free to move, or a newer scan is there already; the last command stays in its column.
    """
    sense_kernel(frame, sense_state, sense_params)
    estimate_kernel(frame, estimate_state, estimate_params)
    detect_kernel(frame, detect_state, detect_params)
    status = int(frame[STATUS])
    if status & COMMANDED:
        actuate_kernel(frame, actuate_state, actuate_params)
    elif status & MANUAL:
        follow_kernel(frame, actuate_state, actuate_params)


@kernel
def run_kernel(
    rows: NDArray[np.float64],
    frame: NDArray[np.float64],
    sense_state: Record,
    sense_params: Record,
    estimate_state: Record,
    estimate_params: Record,
    detect_state: Record,
    detect_params: Record,
    actuate_state: Record,
    actuate_params: Record,
) -> None:
    """``step_kernel`` over ``rows`` (n, Layout.size), in place: inputs in, the whole frame out.

    ``frame`` is the running one: a column that a tick does not write keeps the last tick's value, as in the live loop.
    """
    for k in range(len(rows)):
        row = rows[k]
        status = int(row[STATUS]) & GIVEN_BITS
        for i in range(VOLTS):
            frame[i] = row[i]
        frame[STATUS] = status
        if status & MANUAL:
            for i in range(COMMAND, COMMAND + 3):
                frame[i] = row[i]
        step_kernel(
            frame,
            sense_state,
            sense_params,
            estimate_state,
            estimate_params,
            detect_state,
            detect_params,
            actuate_state,
            actuate_params,
        )
        for i in range(len(frame)):
            row[i] = frame[i]
