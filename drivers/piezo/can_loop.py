"""Does ``CanAmplifier.write`` and ``safe_step`` in a compiled loop: the driver's own functions on its own memory.

What the driver would raise is handed over: a failure of the bus is kept in ``FAILED`` for ``CanAmplifier.pending``, and
a bad link is found again by the driver's ``write``. Importing this module imports numba.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from numpy.typing import NDArray

from drivers.base import next_due_ns
from drivers.can_frames import BEAT_DUE_NS, BEAT_STATE, BEATS, HEARTBEAT_BYTES, HEARTBEAT_PERIOD_NS
from drivers.output_guard_steps import ARMED, RAMP_DONE, GuardState, admit, note_sent
from drivers.piezo.can_node import (
    RECEIVE_LIMIT,
    SAFE_STEPS,
    SETPOINT_BYTES,
    WELL,
    NodeMemory,
    decode_status,
    encode_setpoint,
    is_safe,
    link_fault,
    must_ask,
    note_setpoint,
)
from hal.can_kernels import (
    CAME,
    RECEIVED_NS,
    CanLine,
    data_of,
    identifier,
    new_line,
    put_head,
    receive,
    send,
)
from hal.can_wire import DATA_AT
from hal.compiled import kernel
from hal.fd_kernels import now_ns

if TYPE_CHECKING:
    from drivers.piezo.can_amplifier import CanAmplifier

SETPOINT_ID, COMMAND_ID, STATUS_ID, HEARTBEAT_ID, FAILED, WORDS = range(6)
"""Places in ``CanMemory.words``."""
WRONG_LENGTH = 1 << 32
"""``FAILED`` after a STATUS of a wrong length, which the line still holds; other values are those of
``hal.can_kernels``."""
REAL_TIME = -1
SAFE_COMMAND, COMMAND_BYTES = 0, 2

guard_admit = kernel(admit)
guard_sent = kernel(note_sent)
following_due = kernel(next_due_ns)
node_encode = kernel(encode_setpoint)
node_note = kernel(note_setpoint)
node_decode = kernel(decode_status)
node_fault = kernel(link_fault)
node_must_ask = kernel(must_ask)
node_is_safe = kernel(is_safe)


class CanMemory(NamedTuple):
    """Holds the driver's memory. ``fixed_ns`` (1,): the time in virtual time, else REAL_TIME; ``beat``: the words of
    the host's heartbeat."""

    words: NDArray[np.int64]
    fixed_ns: NDArray[np.int64]
    guard: GuardState
    node: NodeMemory
    beat: NDArray[np.int64]
    line: CanLine


def memory_of(driver: CanAmplifier, carrier: int, fixed_ns: NDArray[np.int64], calls: tuple[int, int]) -> CanMemory:
    """Return the memory of ``driver``, which both then work on, one at a time. ``carrier``: of its bus; ``calls``: see
    ``hal.can_kernels.new_line``."""
    words = [driver.setpoint_id, driver.command_id, driver.status_id, driver.heartbeat.can_id, 0]
    return CanMemory(
        np.array(words), fixed_ns, driver.guard.state.view(), driver.node.view(),
        np.frombuffer(driver.heartbeat.words, np.int64), new_line(carrier, calls),
    )  # fmt: skip


@kernel
def clock_ns(out: CanMemory) -> int:
    """Return the time, the one that virtual time has fixed where there is one."""
    return now_ns() if out.fixed_ns[0] == REAL_TIME else out.fixed_ns[0]


@kernel
def beat(out: CanMemory, fd: int) -> int:
    """Do what ``HostHeartbeat.beat`` does. Return 0 or what ``send`` returned."""
    words, now = out.beat, clock_ns(out)
    if now < words[BEAT_DUE_NS]:
        return 0
    words[BEAT_DUE_NS] = following_due(words[BEAT_DUE_NS], now, HEARTBEAT_PERIOD_NS)
    put_head(out.line, out.words[HEARTBEAT_ID], HEARTBEAT_BYTES)
    out.line.outgoing[DATA_AT] = words[BEAT_STATE]
    failed = send(out.line, fd)
    if failed == 0:
        words[BEATS] += 1
    return failed


@kernel
def poll(out: CanMemory, fd: int) -> bool:
    """Do what ``CanAmplifier.poll`` does. Return False, with the reason in ``FAILED``, where it would raise."""
    failed = beat(out, fd)
    frames = 0
    while failed == 0 and frames < RECEIVE_LIMIT:
        frames += 1
        got = receive(out.line, fd)
        if got < 0:
            failed = got
        elif got == 0:
            break
        elif (
            got == CAME
            and identifier(out.line) == out.words[STATUS_ID]
            and not node_decode(out.node, data_of(out.line), out.line.words[RECEIVED_NS])
        ):
            failed = WRONG_LENGTH
    out.words[FAILED] = failed
    return failed == 0


@kernel
def send_setpoint(out: CanMemory, fd: int) -> bool:
    """Send ``next_V``. Return False, with the reason in ``FAILED``, if the bus did not take it."""
    node_encode(out.node, out.guard.next_V)
    put_head(out.line, out.words[SETPOINT_ID], SETPOINT_BYTES)
    for i in range(SETPOINT_BYTES):
        out.line.outgoing[DATA_AT + i] = out.node.setpoint[i]
    out.words[FAILED] = send(out.line, fd)
    if out.words[FAILED] != 0:
        return False
    node_note(out.node)
    guard_sent(out.guard, clock_ns(out))
    return True


@kernel
def write(out: CanMemory, fd: int, values_V: NDArray[np.float64]) -> tuple[bool, int]:
    """Write ``values_V`` (3,) as ``CanAmplifier.write`` does. Return False if the driver must go on, and the guard's
    mask."""
    if not poll(out, fd) or node_fault(out.node, clock_ns(out)) != WELL:
        return False, 0
    mask = guard_admit(out.guard, values_V, clock_ns(out))
    if mask < 0 or not send_setpoint(out, fd):
        return False, 0
    return True, mask


@kernel
def step_ramp(out: CanMemory, fd: int) -> bool:
    """Do what ``CanAmplifier.safe_step`` does. Return True once the node has confirmed that its outputs are neutral. A
    bus that fails leaves the ramp to the node's own watchdog."""
    guard = out.guard
    guard.words[ARMED] = 0
    if node_must_ask(out.node, clock_ns(out)):
        put_head(out.line, out.words[COMMAND_ID], COMMAND_BYTES)
        out.line.outgoing[DATA_AT] = SAFE_COMMAND
        out.line.outgoing[DATA_AT + 1] = SAFE_COMMAND ^ 0xFF
        if send(out.line, fd) != 0:
            return False
    out.node.words[SAFE_STEPS] += 1
    if not poll(out, fd) or not node_is_safe(out.node):
        return False
    guard.last_V[:] = guard.safe_V
    guard.words[RAMP_DONE] = -1
    return True
