"""The way of a sample in one compiled thread, from descriptor to descriptor, as `benchmarks.wire` measures it.

It waits, reads, decodes, checks, steps, encodes and writes with the kernels that the firmware runs, and never takes the
GIL. It is no firmware: output guard, guardian's gate, supervisor and recorder are not in it (see docs/architecture.md),
so nothing that moves may hang on it.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from drivers.daq.di4108_kernels import READY, WAIT, accept, decode, new_stream
from drivers.piezo.e727_kernels import TEXT_BYTES, encode
from firmware_py.control.chain import COMMANDED, step_kernel
from firmware_py.control.plausibility import CheckMemory, PlausibilityLimits, ScanCheck, check_frame, check_scan
from firmware_py.control.stages import Stages
from firmware_py.frame import COMMAND, COUNTS, MAGNETOMETER_FRESH, STATUS, TICK, TIME
from hal.compiled import kernel, thread_kernel
from hal.fd_kernels import POLLIN, now_ns, poll_word, read_fd, wait_fds, write_fd

Record = Any
CHANNELS = 8
FIELD_TICKS = 10
"""The magnetometer is read every so many ticks; its volts stay those of the frame."""
PATIENCE_NS = 2_000_000_000
ENDED, FAILED, IMPLAUSIBLE, BAD_STREAM = 0, 1, 2, 3
"""Why ``serve`` returned: all scans were answered, or the peer has closed the port; a call failed; a scan was
implausible; bytes are missing or the device has stopped itself."""


class Buffers(NamedTuple):
    """Memory of ``serve``: bytes that were read, scans, the text of a command."""

    room: NDArray[np.uint8]
    rows: NDArray[np.int16]
    text: NDArray[np.uint8]


def new_checks(lsb_V: float) -> CheckMemory:
    """Return the default limits, before the first scan."""
    return ScanCheck(PlausibilityLimits(), lsb_V, range(CHANNELS), [""] * CHANNELS).memory


def new_buffers() -> Buffers:
    return Buffers(np.zeros(1 << 16, np.uint8), np.zeros((1024, CHANNELS), np.int16), np.zeros(TEXT_BYTES, np.uint8))


@kernel
def tick(memory: Record, scan: NDArray[np.int16], k: int, newest: bool, checks: CheckMemory) -> bool:
    """Check the scan, run the step, check its pairs, as the loop's tasks sense and estimate do. Return True if both
    checks passed. ``newest``: the step computes a command."""
    frame = memory[0].frame
    frame[TIME], frame[TICK], frame[STATUS] = k * 1e-3, k, COMMANDED if newest else 0
    frame[MAGNETOMETER_FRESH] = 1.0 if k % FIELD_TICKS == 0 else 0.0
    for i in range(CHANNELS):
        frame[COUNTS + i] = scan[i]
    if check_scan(scan, k, checks):
        return False
    step_kernel(memory)
    return check_frame(frame, checks) <= 0


@thread_kernel
def serve(
    scans_fd: int, commands_fd: int, ticks: int, memory: Record, stream: Record, checks: CheckMemory, buffers: Buffers
) -> int:
    """Answer ``ticks`` scans of the DI-4108 on ``scans_fd`` with an E-727's commands on ``commands_fd``, one for the
    newest scan of each read. Return why it ended."""
    command_V = memory[0].frame[COMMAND : COMMAND + 3]
    polls = np.zeros(1, np.int64)
    done = 0
    while done < ticks:
        polls[0] = poll_word(scans_fd, POLLIN)
        if wait_fds(polls, now_ns() + PATIENCE_NS) <= 0:
            return FAILED
        end = stream[0].end
        n = read_fd(scans_fd, buffers.room, end, len(buffers.room))
        if n <= 0:
            return FAILED if n < 0 else ENDED
        verdict = accept(stream, buffers.room, n, now_ns())
        if verdict == WAIT:
            continue
        if verdict != READY:
            return BAD_STREAM
        got, _, seq0, _, _ = decode(stream, buffers.room, buffers.rows)
        for k in range(got):
            if not tick(memory, buffers.rows[k], seq0 + k, k == got - 1, checks):
                return IMPLAUSIBLE
        size = encode(buffers.text, False, command_V, 1.0)
        if write_fd(commands_fd, buffers.text, size, 0) < size:
            return FAILED
        done += got
    return ENDED


@thread_kernel
def echo(fd: int, times: int, room: NDArray[np.uint8]) -> int:
    """Send back what comes, ``times`` times: the same calls with nothing between them."""
    polls = np.zeros(1, np.int64)
    for _ in range(times):
        polls[0] = poll_word(fd, POLLIN)
        if wait_fds(polls, now_ns() + PATIENCE_NS) <= 0:
            return FAILED
        n = read_fd(fd, room, 0, len(room))
        if n <= 0 or write_fd(fd, room, n, 0) < n:
            return FAILED
    return ENDED


def serve_port(stages: Stages, fd: int, ticks: int) -> int:
    """``serve`` on one port, which is made non-blocking by its owner."""
    stream = new_stream(CHANNELS, 16, 1000.0)
    return serve(fd, fd, ticks, stages.memory, stream, new_checks(5.0 / 32768), new_buffers())
